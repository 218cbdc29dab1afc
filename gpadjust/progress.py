"""Progress bars, on request or of long work by itself."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from importlib.util import find_spec
from typing import Any

PATIENCE = 5.0  # seconds, before long work shows a bar by itself
_BAR: ContextVar[tuple[str, Any]] = ContextVar("bar", default=("", None))


class _Hidden:
    """The methods of a bar of tqdm that this library calls, without a bar."""

    iterable: Iterable[Any] = ()
    n = 0

    def __enter__(self) -> _Hidden:
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def __iter__(self) -> Iterator[Any]:
        return iter(self.iterable)

    def update(self, n: int = 1) -> None:
        self.n += n

    def set_description(self, text: str) -> None:
        pass

    def set_postfix(self, **values: object) -> None:
        pass


def progress_bar(shown: bool, iterable: Iterable[Any] = (), **options: Any) -> Any:
    """Return a bar of tqdm with these options, or an object with its methods that is not shown.

    Raises:
        ImportError: If a bar is shown, and tqdm is not installed.

    Example:
        >>> with progress_bar(False, total=3) as bar:
        ...     bar.update(2)
        >>> bar.n, [*progress_bar(False, "ab")]
        (2, ['a', 'b'])
    """
    if not shown:
        hidden = _Hidden()
        hidden.iterable = iterable
        return hidden
    try:
        from tqdm import tqdm
    except ImportError as error:
        raise ImportError("A progress bar needs tqdm; run `pip install tqdm`.") from error
    return tqdm(iterable, **options)


@contextmanager
def long_work(text: str, unit: str, *, total: int | None = None) -> Iterator[None]:
    """Show a bar of the units that :func:`tick` counts in a block of more than five seconds.

    It is shown in a terminal or a notebook, if tqdm is installed, with a total also the time left.
    """
    is_seen = hasattr(sys, "ps1") or (sys.stderr is not None and sys.stderr.isatty())
    if not (is_seen and find_spec("tqdm")):
        yield
        return
    options: dict[str, Any] = {"desc": text, "unit": f" {unit}", "total": total}
    options |= {"leave": False, "miniters": 1, "delay": PATIENCE}
    with progress_bar(True, **options) as bar:
        token = _BAR.set((unit, bar))
        try:
            yield
        finally:
            _BAR.reset(token)


def tick(unit: str, to: int | None = None) -> None:
    """Count a unit, or set their number, if the innermost long work counts such units."""
    unit_of_bar, bar = _BAR.get()
    if unit_of_bar == unit:
        bar.update(1 if to is None else to - bar.n)
