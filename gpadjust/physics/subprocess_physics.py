"""An external program as physics."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from string import Formatter
from tempfile import NamedTemporaryFile

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpadjust.checks import checked_number
from gpadjust.physics.black_box import BlackBoxPhysics
from gpadjust.physics.unknown import Unknown

_SHOWN = 200  # characters of an output that is not understood


class SubprocessPhysics(BlackBoxPhysics):
    """Physics given as an external program, which is run once for each row.

    Placeholders in its arguments, ``{T}``, are replaced by the values of a row: by the name of an
    input or unknown parameter, or by the number of an input, from 0. Formats are those of Python
    (``{T:.3f}``; by default all digits), and ``{{`` is a brace. The outputs are what the program
    prints. If its exit code is not 0, the row fails, with what it wrote to stderr in the error.

    Rows run in parallel inside ``with joblib.parallel_config(n_jobs=4)``, and are remembered, as of
    a :class:`~gpadjust.BlackBoxPhysics`. There is no gradient in X, as programs seldom print the
    digits that differences need.

    Args:
        command: The program and its arguments, ``["prog", "--temperature", "{T}"]``; no shell.
        names: The names of the inputs, in their order, for placeholders.
        unknowns: Unknown parameters by name, each of which has a placeholder.
        stdin: A text with placeholders that the program reads from its standard input. Default:
            nothing.
        parse: Maps the printed text to the outputs, a number or ``m``. Default: it is numbers
            alone, between spaces, commas or line ends.
        timeout: Seconds after which a run is ended, and has failed. Default: none.
        cache: A folder in which outputs are kept, by command and ``stdin``, for all processes that
            name it. A run that failed is not kept. The program itself may change unseen: remove the
            folder after that.
        inputs: The columns of X that the program reads. Default: all.
        name: The name in messages. Default: the program's.

    Raises:
        TypeError: If ``command`` is one text, or not a list of texts.
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
        names: Sequence[str] = (),
        unknowns: Mapping[str, Unknown] | None = None,
        stdin: str | None = None,
        parse: Callable[[str], ArrayLike] | None = None,
        timeout: float | None = None,
        cache: str | Path | None = None,
        inputs: Sequence[int] | None = None,
        name: str | None = None,
    ) -> None:
        is_list = not isinstance(command, str) and all(isinstance(part, str) for part in command)
        if not is_list or not command:
            raise TypeError(
                f"command must be a list of texts, ['prog', '{{T}}'], found {command!r}; "
                "shlex.split makes one of a line."
            )
        if timeout is not None:
            checked_number("timeout", timeout, above=0)
        found = _placeholders([*command, stdin or ""])
        known = [*names, *(unknowns or ())]
        if unclear := sorted(each for each in found if not each.isdigit() and each not in known):
            raise ValueError(
                f"The placeholder {{{unclear[0]}}} is no name of an input or unknown parameter; "
                f"expected one of {', '.join(known) or 'none'}. Give names=['T', ...] in the order "
                "of the inputs, or take their numbers, {0}; a brace itself is {{."
            )
        if silent := [each for each in (unknowns or ()) if each not in found]:
            raise ValueError(
                f"The command has no placeholder of the unknown parameter {silent[0]}; expected "
                f"{{{silent[0]}}} where its value goes."
            )
        folder = None if cache is None else Path(cache).absolute()
        super().__init__(
            _Run(tuple(command), tuple(names), stdin, parse or _numbers, timeout, folder),
            unknowns=unknowns,
            batched=False,
            gradient=None,
            inputs=inputs,
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
        """Return the outputs at a row of inputs."""
        values = row.tolist()
        if self.names and len(self.names) != len(values):
            raise ValueError(
                f"names has {len(self.names)} entries, {', '.join(self.names)}, but a row "
                f"{len(values)}; name every column that is read, or give inputs=[...]"
            )
        named = dict(zip(self.names, values, strict=False))
        for each in parameters:
            named |= {name: float(value) for name, value in each.items()}
        command = [part.format(*values, **named) for part in self.command]
        stdin = None if self.stdin is None else self.stdin.format(*values, **named)
        return self.parse(self._output(command, stdin))

    def _output(self, command: list[str], stdin: str | None) -> str:
        """Return the printed text, from the cache if it is there."""
        if self.cache is None:
            return _printed(command, stdin, self.timeout)
        key = json.dumps({"command": command, "stdin": stdin})
        file = self.cache / f"{hashlib.sha256(key.encode()).hexdigest()}.json"
        with suppress(OSError, ValueError, KeyError):  # without a file, or with a damaged one
            return str(json.loads(file.read_text(encoding="utf-8"))["stdout"])
        text = _printed(command, stdin, self.timeout)
        self.cache.mkdir(parents=True, exist_ok=True)
        with NamedTemporaryFile(
            "w", encoding="utf-8", dir=self.cache, suffix=".part", delete=False
        ) as part:
            json.dump({**json.loads(key), "stdout": text}, part)
        Path(part.name).replace(file)  # at once, as other processes may read or write it now
        return text


def _numbers(text: str) -> list[float]:
    """Return the numbers in a text of nothing else."""
    try:
        if words := text.replace(",", " ").split():
            return [float(word) for word in words]
    except ValueError:
        pass
    raise ValueError(
        f"the program printed {text.strip()[:_SHOWN]!r}, expected numbers alone; give parse=..., a "
        "function from the text to the outputs"
    )


def _printed(command: list[str], stdin: str | None, timeout: float | None) -> str:
    """Return the text that a program prints; an error if it fails."""
    pipe = subprocess.PIPE
    source = subprocess.DEVNULL if stdin is None else pipe
    try:
        process = subprocess.Popen(
            command, stdin=source, stdout=pipe, stderr=pipe, text=True, start_new_session=True
        )
    except FileNotFoundError:
        raise FileNotFoundError(
            f"the program {command[0]!r} was not found where it is to run; give its full path"
        ) from None
    with process:
        try:
            printed, written = process.communicate(stdin, timeout)
        except BaseException:
            if os.name == "posix":  # with all that it has started
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
            process.kill()
            raise
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command, printed, written)
    return printed


def _placeholders(texts: Sequence[str]) -> set[str]:
    """Return the names and numbers in braces."""
    try:
        fields = [field for text in texts for _, field, _, _ in Formatter().parse(text)]
    except ValueError as error:
        raise ValueError(
            f"The texts {texts!r} are no templates ({error}); a brace itself is {{{{ or }}}}."
        ) from None
    return {field for field in fields if field is not None}
