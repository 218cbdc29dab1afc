"""The warning of a physics that is obviously off."""


class PhysicsWarning(UserWarning):
    """A physics is obviously off at the training inputs, and it shows why.

    It is given by what judges a physics by data: ``gpadjust.validation.compare``, the report and
    ``CKARegressor``, by at least five observations of an output: a factor, as of other units; the
    opposite sign; an offset; inputs, or targets, that were scaled beforehand, while f_p reads and
    returns raw units. A physics with unknown parameters is not judged: its first values are
    guesses. A fit of unknown parameters of dynamics warns where the transitions say nothing of one.

    Example:
        >>> import warnings, torch
        >>> from gpadjust import CKA, PhysicsWarning
        >>> from gpadjust.validation import compare
        >>> X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
        >>> with warnings.catch_warnings(record=True) as caught:
        ...     warnings.simplefilter("always")
        ...     table = compare(X, torch.sin(6 * X), physics=lambda X: 1000 * torch.sin(6 * X))
        >>> [each] = [each for each in caught if each.category is PhysicsWarning]
        >>> "f_p is about 1,000 times too large" in str(each.message)
        True
    """
