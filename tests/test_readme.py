"""What the README shows runs, and its commands are those of CI."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()


def test_the_examples_run(capsys):
    first, second, *_ = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    names = {}
    exec(first, names)
    truth = 2 * names["f_p"](names["test_X"]) + names["test_X"]
    assert (names["posterior"].mean - truth).abs().max() < 1e-2
    assert (names["rho"].mean - 2).abs().max() < 0.5
    exec(second, names)
    assert "physics mean" in capsys.readouterr().out
    assert (names["mixture"].mixture_mean - truth).abs().max() < 1e-2
    assert names["loo"].rmse < 1e-2


@pytest.mark.filterwarnings("ignore:rich is experimental")
def test_the_agent_learns_and_goes_on(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, again = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)[2:]
    for long, short in (("=10 * 25", "=2 * 25"), ("model_trials=20", "model_trials=2")):
        assert long in code
        code = code.replace(long, short)
    names = {}
    exec(code, names)
    assert names["agent"].num_trials == 2
    assert {path.name for path in tmp_path.iterdir()} == {"cart_pole.ckpt", "cart_pole.zip"}
    assert "10 * 25" in again
    exec(again.replace("10 * 25", "3 * 25"), names)
    assert names["agent"].num_trials == 3


def test_ci_runs_the_test_command():
    _, tests = re.findall(r"```bash\n(.*?)\n```", README, flags=re.DOTALL)
    script = (ROOT / ".ci" / "run").read_text()
    install, run = tests.split(" && ")
    assert install.replace("pip install", "pip install --quiet") in script
    assert run in script
