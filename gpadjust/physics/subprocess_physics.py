"""An external program as physics."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from string import Formatter

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpadjust.physics.black_box import BlackBoxPhysics
from gpadjust.physics.unknown import Unknown


class SubprocessPhysics(BlackBoxPhysics):
    """Physics given as an external program, which is run once for each row.

    Placeholders in its arguments, ``{T}``, are replaced by the values of a row: by the name of an
    input or unknown parameter, or by the number of an input, from 0. Formats are those of Python
    (``{T:.3f}``; by default all digits), and ``{{`` is a brace. The outputs are the printed
    numbers. If the exit code is not 0, the row fails, with the program's stderr in the error.

    Rows run in parallel and are remembered as of a :class:`~gpadjust.BlackBoxPhysics`, by the
    process; ``joblib.Memory`` keeps outputs of a function on the disk. There is no gradient in X,
    as programs seldom print the digits that differences need.

    Args:
        command: The program and its arguments, ``["prog", "--temperature", "{T}"]``; no shell.
        names: The names of the inputs, in their order, for placeholders.
        stdin: A text with placeholders for the program's standard input. Default: nothing.
        parse: Maps the printed text to the outputs. Default: numbers between blanks or commas.
        timeout: Seconds after which a run is ended, and has failed. Default: none.
        unknowns, inputs, name: As of :class:`Physics`; each unknown parameter has a placeholder.

    Example:
        >>> import sys, torch
        >>> program = "import sys; t, k = map(float, sys.argv[1:]); print(k * t**2)"
        >>> fall = SubprocessPhysics([sys.executable, "-c", program, "{t}", "4.9"], names=["t"])
        >>> fall(torch.tensor([[2.0]], dtype=torch.float64))
        tensor([[19.6000]], dtype=torch.float64)
    """

    def __init__(
        self,
        command: Sequence[str],
        *,
        names: Sequence[str] = (),
        unknowns: Mapping[str, Unknown] | None = None,
        stdin: str = "",
        parse: Callable[[str], ArrayLike] | None = None,
        timeout: float | None = None,
        inputs: Sequence[int] | None = None,
        name: str | None = None,
    ) -> None:
        if isinstance(command, str) or not command:
            raise TypeError(f"command must be a list, as of shlex.split; found {command!r}.")
        name = name or Path(command[0]).name
        super().__init__(
            self._run, unknowns=unknowns, batched=False, gradient=None, inputs=inputs, name=name
        )
        # A part is a text, and the name and format of a placeholder or None.
        parts = [part for text in (*command, stdin) for part in Formatter().parse(text)]
        fields = {field for _, field, _, _ in parts if field is not None}
        unclear = {field for field in fields if not field.isdigit()} - {*names, *self.unknowns}
        if unclear or not fields >= {*self.unknowns}:
            raise ValueError(
                f"The placeholders are {sorted(fields)}; expected inputs, which are "
                f"names={[*names]} or numbers, {{0}}, and each unknown parameter, "
                f"{[*self.unknowns]}. A brace itself is {{{{."
            )
        self.command = tuple(command)
        self.names = tuple(names)
        self.stdin = stdin
        self.parse = parse or _numbers
        self.timeout = timeout

    def _run(self, row: NDArray[np.float64], *parameters: Mapping[str, float]) -> ArrayLike:
        """Return the outputs at a row of inputs."""
        values = row.tolist()  # whose texts have all digits
        if self.names and len(self.names) != len(values):
            raise ValueError(f"expected names of all columns, or inputs=, found {self.names}")
        named = dict(zip(self.names, values, strict=False))
        for values_of_parameters in parameters:
            named |= values_of_parameters
        command = [part.format(*values, **named) for part in self.command]
        text = _printed(command, self.stdin.format(*values, **named), self.timeout)
        return self.parse(text)


def _numbers(text: str) -> list[float]:
    """Return the numbers in a text of nothing else."""
    return [float(word) for word in text.replace(",", " ").split()]


def _printed(command: list[str], stdin: str, timeout: float | None) -> str:
    """Return the text that a program prints; an error if it fails."""
    pipe = subprocess.PIPE
    with subprocess.Popen(
        command, stdin=pipe, stdout=pipe, stderr=pipe, text=True, start_new_session=True
    ) as process:
        try:
            printed, written = process.communicate(stdin, timeout)
        except BaseException:
            if os.name == "posix":  # with all that it has started, as one session
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
            process.kill()
            raise
    if process.returncode != 0:
        raise subprocess.CalledProcessError(process.returncode, command, printed, written)
    return printed
