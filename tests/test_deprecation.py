"""Names on their way out."""

import pytest

import gpadjust
from gpadjust.deprecation import deprecated


class Old:
    @deprecated("0.2", "99.0", instead="New")
    def __init__(self, x):
        self.x = x

    @deprecated("0.2", "99.0", instead="Old.y")
    def z(self, *, by):
        """Documented."""
        return by * self.x


def test_a_call_warns_and_goes_on():
    with pytest.warns(FutureWarning, match=r"^Old is .* since gpadjust 0\.2 .* 99\.0; use New\.$"):
        old = Old(3)
    with pytest.warns(FutureWarning, match=r"Old\.z is deprecated.*use Old\.y") as heard:
        assert old.z(by=2) == 6
    assert heard[0].filename == __file__
    assert Old.z.__doc__ == "Documented."


@pytest.mark.parametrize(
    ("since", "until", "right"),
    [
        ("0.2", "0.4", True),
        ("0.2", "0.3", False),
        ("0.2", "0.3.9", False),
        ("0.9", "0.11", True),
        ("0.9", "0.10", False),
        ("0.9", "1.0", True),
    ],
)
def test_a_name_stays_for_two_minor_versions(since, until, right):
    if right:
        deprecated(since, until, instead="x")
    else:
        with pytest.raises(ValueError, match="two minor versions"):
            deprecated(since, until, instead="x")


@pytest.mark.parametrize("now", ["0.4.0", "0.4.2", "0.10.0", "1.0.0"])
def test_a_name_past_its_version_stops_the_import(now, monkeypatch):
    """So no version can be released that has it."""
    monkeypatch.setattr(gpadjust, "__version__", now)
    with pytest.raises(ValueError, match=r"gone in 0\.4 is to be removed now"):
        deprecated("0.2", "0.4", instead="x")
    monkeypatch.setattr(gpadjust, "__version__", "0.3.7")
    deprecated("0.2", "0.4", instead="x")
