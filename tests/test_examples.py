"""Every example and every command of the README really runs."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
METHOD = ROOT / "examples" / "your_method.py"  # no program: the commands of the README run it
EXAMPLES = sorted(set((ROOT / "examples").glob("*.py")) - {METHOD})
# Commands that CI runs elsewhere or that need a display or minutes.
ELSEWHERE = ("--view", "bench full", "bench core", "bench real")
TUTORIAL = [
    "cp examples/your_method.py .",
    "toftools bench quick --method your_method:make --out out/mine",
]
OTHERS = ("make ", "git ", "cd ", "python3 ")


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda p: p.name)
def test_example_runs_and_is_short(path, tmp_path):
    assert len(path.read_text().splitlines()) < 80
    done = subprocess.run([sys.executable, str(path)], cwd=tmp_path, capture_output=True, text=True,
                          check=False)  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip()


def readme_commands():
    """Lines of the README's shell blocks, continuation lines joined, comments dropped."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```(?:sh|console|bash)\n(.*?)```", text, re.DOTALL)
    lines = "".join(blocks).replace("\\\n", " ").splitlines()
    commands = [re.sub(r"\s+#.*", "", line).strip() for line in lines]
    return [c for c in commands if c and not c.startswith("#")]


def test_readme_commands_run_in_order(tmp_path):
    commands = [c for c in readme_commands()
                if not c.startswith(OTHERS) and not any(s in c for s in ELSEWHERE)]  # fmt: skip
    assert len(commands) >= 5
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    printed = {command: typed(command, tmp_path) for command in commands}
    check_own_method(tmp_path / "out" / "mine", printed[TUTORIAL[-1]])


def typed(command, folder):
    """What a command prints, run in a folder as a user types it there: nothing is on a path."""
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    done = subprocess.run(command, shell=True, cwd=folder, env=environment, capture_output=True,
                          text=True, check=False)  # fmt: skip
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def check_own_method(out, printed):
    """The method of the tutorial has its row in the results, in the terminal and in the report."""
    rows = [json.loads(line) for line in (out / "results.jsonl").read_text().splitlines()]
    mine = [row for row in rows if row["method"] == "your_method:make"]
    assert [row["status"] for row in mine] == ["ok"] * 3
    errors = {row["capture"].partition("-")[0]: row["metrics"]["mae_m"] for row in mine}
    assert errors["wall"] < 0.01  # noise alone
    # Bounces and second returns move 70 MHz less than the mean of both frequencies.
    assert all(row["metrics"]["mae_m"] < 1.3 * row["metrics"]["input_mae_m"] for row in mine)
    assert errors["corner"] < 0.05 and errors["two_returns"] < 0.08
    assert all(row["ms"] > 0 and row["metrics"]["valid_share"] > 0.99 for row in mine)
    shown = next(line for line in printed.splitlines() if line.startswith("your_method:make"))
    assert shown.split()[1] == f"{100 * sum(errors.values()) / 3:.2f}"
    assert "your_method:make" in (out / "report.html").read_text(encoding="utf-8")


def test_the_tutorial_is_short_and_its_commands_are_the_readmes():
    code = METHOD.read_text(encoding="utf-8").split("\ndef make", 1)[1]
    assert len([line for line in code.splitlines() if line.strip()]) <= 10
    text = (ROOT / "docs" / "benchmark.md").read_text(encoding="utf-8")
    assert METHOD.read_text(encoding="utf-8").split('"""')[2].strip() in text
    commands = readme_commands()
    assert METHOD.read_text(encoding="utf-8").split('"""')[1].strip().splitlines()[-2:] == TUTORIAL
    for command in TUTORIAL:
        assert command in commands and f"\n{command}\n" in text


def test_readme_python_blocks_run(tmp_path):
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert blocks
    for block in blocks:
        done = subprocess.run([sys.executable, "-c", block], cwd=tmp_path, capture_output=True,
                              text=True, check=False)  # fmt: skip
        assert done.returncode == 0, done.stderr


def test_readme_pictures_exist():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    pictures = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", text)
    assert pictures
    for picture in pictures:
        assert (ROOT / picture).is_file(), picture
