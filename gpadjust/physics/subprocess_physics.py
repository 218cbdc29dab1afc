"""An external program as physics."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from string import Formatter
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpadjust.physics.black_box import BlackBoxPhysics, NumpyFunction
from gpadjust.physics.unknown import Unknown

_SHOWN = 200  # characters of an output that is not understood


class SubprocessPhysics(BlackBoxPhysics):
    """Physics given as an external program, which is run once for each row.

    Placeholders in its arguments, ``{T}``, are replaced by the values of a row: by the name of an
    input or unknown parameter, or by the number of an input, from 0. Formats are those of Python
    (``{T:.3f}``; by default all digits), and ``{{`` is a brace. What the program prints are its
    outputs. Its exit code says whether it worked: what it wrote to stderr is in the error.

    Rows run in parallel inside ``with joblib.parallel_config(n_jobs=4)``, as of a
    :class:`~gpadjust.BlackBoxPhysics`, whose memory and other arguments it has, too.

    Args:
        command: The program and its arguments, ``["prog", "--temperature", "{T}"]``; no shell.
        names: The names of the inputs, in their order, for placeholders.
        unknowns: Unknown parameters by name, each of which has a placeholder.
        stdin: A text with placeholders that the program reads from its standard input. Default:
            nothing.
        parse: Maps what it printed to the outputs, a number or ``m``. Default: it is numbers alone,
            apart by spaces, commas or lines.
        timeout: Seconds after which a run is ended, and has failed. Default: none.
        cache: A folder in which outputs are kept, by command and ``stdin``, for all processes that
            name it. A run that failed is not kept. The program itself may change unseen: remove the
            folder after that.
        gradient: As of :class:`~gpadjust.BlackBoxPhysics`. Default: None, as programs seldom print
            the digits that differences need.
        fd_step: Likewise.
        inputs: The columns of X that the program reads. Default: all.
        memo: Likewise.
        name: The name in messages. Default: the program's.

    Raises:
        TypeError: If ``command`` is one text, or no list of texts.
        ValueError: If a placeholder names nothing, or an unknown parameter has none.

    Example:
        >>> import sys, torch
        >>> program = "import sys; t, k = map(float, sys.argv[1:]); print(k * t**2)"
        >>> fall = SubprocessPhysics([sys.executable, "-c", program, "{t}", "4.9"], names=["t"])
        >>> fall(torch.tensor([[1.0], [2.0]], dtype=torch.float64))
        tensor([[ 4.9000],
                [19.6000]], dtype=torch.float64)
    """

    def __init__(
        self,
        command: Sequence[str],
        *,
        names: Sequence[str] | None = None,
        unknowns: Mapping[str, Unknown] | None = None,
        stdin: str | None = None,
        parse: Callable[[str], ArrayLike] | None = None,
        timeout: float | None = None,
        cache: str | Path | None = None,
        gradient: Literal["finite-difference"] | NumpyFunction | None = None,
        fd_step: float | Sequence[float] | None = None,
        inputs: Sequence[int] | None = None,
        memo: int = 100_000,
        name: str | None = None,
    ) -> None:
        if isinstance(command, str) or not all(isinstance(part, str) for part in command):
            raise TypeError(
                f"command must be a list of texts, ['prog', '{{T}}'], found {command!r}; "
                "shlex.split makes one of a line."
            )
        if not command:
            raise ValueError("command is empty; name the program that is to run.")
        if timeout is not None and not timeout > 0:
            raise ValueError(f"timeout must be a positive number of seconds; found {timeout}.")
        own, asked = [*(names or ()), *(unknowns or ())], _placeholders([*command, stdin or ""])
        unclear = sorted(each for each in asked if not each.isdigit() and each not in own)
        if unclear:
            raise ValueError(
                f"The placeholder {{{unclear[0]}}} is no name of an input or unknown parameter; "
                f"there are {', '.join(own) or 'none'}. Say names=['T', ...] in the order of the "
                "inputs, or take their numbers, {0}; a brace that is none is written {{."
            )
        if silent := [each for each in (unknowns or ()) if each not in asked]:
            raise ValueError(
                f"The command has no placeholder of the unknown parameter {silent[0]}: say where "
                f"its value goes by {{{silent[0]}}}."
            )
        run = _Run(
            tuple(command),
            tuple(names or ()),
            stdin,
            parse or numbers,
            timeout,
            None if cache is None else Path(cache).absolute(),
        )
        super().__init__(
            run,
            unknowns=unknowns,
            batched=False,
            gradient=gradient,
            fd_step=fd_step,
            inputs=inputs,
            memo=memo,
            name=name or Path(command[0]).name,
        )


@dataclass(frozen=True)
class _Run:
    """A run of the program; other processes have a copy of it."""

    command: tuple[str, ...]
    names: tuple[str, ...]
    stdin: str | None
    parse: Callable[[str], ArrayLike]
    timeout: float | None
    cache: Path | None

    def __call__(self, row: NDArray[np.float64], *parameters: Mapping[str, float]) -> ArrayLike:
        """The outputs at a row of inputs."""
        values = [float(value) for value in row]
        if self.names and len(self.names) != len(values):
            raise ValueError(
                f"names has {len(self.names)} entries, {', '.join(self.names)}, but a row "
                f"{len(values)}; name every column that is read, or say inputs=[...]"
            )
        named = dict(zip(self.names, values, strict=False))
        for each in parameters:
            named |= {name: float(value) for name, value in each.items()}
        command = [part.format(*values, **named) for part in self.command]
        stdin = None if self.stdin is None else self.stdin.format(*values, **named)
        return self.parse(self._output(command, stdin))

    def _output(self, command: list[str], stdin: str | None) -> str:
        """What the program prints, from the cache if it is there."""
        if self.cache is None:
            return _printed(command, stdin, self.timeout)
        asked = json.dumps({"command": command, "stdin": stdin})
        file = self.cache / f"{hashlib.sha256(asked.encode()).hexdigest()}.json"
        with suppress(OSError, ValueError, KeyError):  # a file that is not whole is none
            kept = json.loads(file.read_text(encoding="utf-8"))
            return str(kept["stdout"])
        text = _printed(command, stdin, self.timeout)
        self.cache.mkdir(parents=True, exist_ok=True)
        handle, part = tempfile.mkstemp(dir=self.cache, suffix=".part")
        try:
            with os.fdopen(handle, "w", encoding="utf-8") as stream:
                json.dump({**json.loads(asked), "stdout": text}, stream)
            Path(part).replace(file)  # at once, for whoever reads or writes it at this moment
        finally:
            Path(part).unlink(missing_ok=True)
        return text


def numbers(text: str) -> list[float]:
    """The numbers in a text of nothing else, apart by spaces, commas or lines."""
    words = text.replace(",", " ").split()
    try:
        found = [float(word) for word in words]
    except ValueError:
        found = []
    if not found:
        shown = text.strip()[:_SHOWN]
        raise ValueError(
            f"the program printed {shown!r}, expected numbers alone; give parse=..., a function "
            "from the text to the outputs"
        )
    return found


def _printed(command: list[str], stdin: str | None, timeout: float | None) -> str:
    """What a program prints; an error if it fails."""
    pipe = subprocess.PIPE
    own: dict[str, Any] = {"start_new_session": True} if os.name == "posix" else {}
    given = subprocess.DEVNULL if stdin is None else pipe
    try:
        process = subprocess.Popen(command, stdin=given, stdout=pipe, stderr=pipe, text=True, **own)
    except FileNotFoundError:
        raise FileNotFoundError(
            f"the program {command[0]!r} was not found where it is to run; give its full path"
        ) from None
    with process:
        try:
            printed, written = process.communicate(stdin, timeout)
        except BaseException:
            _end(process)
            raise
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command, printed, written)
    return printed


def _end(process: subprocess.Popen[str]) -> None:
    """End a program, and those that it has started."""
    if os.name == "posix":
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    process.kill()


def _placeholders(texts: Sequence[str]) -> set[str]:
    """The names and numbers in braces."""
    found: set[str] = set()
    for text in texts:
        try:
            fields = [name for _, name, _, _ in Formatter().parse(text) if name is not None]
        except ValueError as error:
            raise ValueError(
                f"The text {text!r} is no template ({error}); a brace that is no placeholder's is "
                "written {{ or }}."
            ) from None
        found |= {*fields}
    return found
