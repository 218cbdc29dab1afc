"""The warning of a physics that is obviously off."""


class PhysicsWarning(UserWarning):
    """A physics is obviously off at the training inputs, and it shows why.

    It is given when a model of the physics is built, by at least five observations of an output: a
    factor, as of other units; the opposite sign; an offset; inputs, or targets, that were scaled
    beforehand, while f_p reads and returns raw units. What the model learns anyway is not warned
    of: an offset where the center or ``delta_mean`` is learnt, a factor where ``rho_mean`` is. Nor
    is a physics with unknown or trainable parameters, whose first values are guesses.

    Example:
        >>> import warnings, torch
        >>> from gpadjust import CKA, PhysicsWarning
        >>> X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
        >>> with warnings.catch_warnings(record=True) as caught:
        ...     warnings.simplefilter("always")
        ...     model = CKA(X, torch.sin(6 * X), physics=lambda X: 1000 * torch.sin(6 * X))
        >>> caught[0].category is PhysicsWarning
        True
        >>> "f_p is about 1,000 times too large" in str(caught[0].message)
        True
    """
