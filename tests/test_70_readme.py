"""What the README shows works, and says what the project does."""

import re
import tomllib
from pathlib import Path

import pytest

from tscorr.config import Config, load_config
from tscorr.correction import SINGLE_FLAGS

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language):
    """Fenced blocks of one language, without the indent of the list they stand in."""
    found = re.findall(rf"^( *)```{language}\n(.*?)^ *```", README, flags=re.MULTILINE | re.DOTALL)
    return [re.sub(rf"^{indent}", "", text, flags=re.MULTILINE) for indent, text in found]


def test_ci_calls_the_test_command_as_the_readme_gives_it():
    (command,) = [block.strip() for block in blocks("sh") if "pytest" in block]
    assert command in (ROOT / ".ci" / "run").read_text(encoding="utf-8")


def test_the_run_command_names_a_configuration_that_loads():
    (command,) = [block.strip() for block in blocks("sh") if "tscorr run" in block]
    path = command.split("tscorr run ")[1].split()[0]
    assert [scene.name for scene in load_config(ROOT / path).scenes] == ["forward", "nadir", "line"]


def test_the_configuration_shown_is_complete():
    (text,) = blocks("toml")
    config = Config.model_validate(tomllib.loads(text))
    assert config.scenes[0].view.kind == "frame"


def test_every_setting_and_flag_is_named():
    for model in (
        Config,
        *(Config.model_fields[name].annotation for name in ("output", "model", "correction", "run")),
    ):
        for key in model.model_fields:
            assert f"`{key}`" in README or f"[{key}]" in README or key == "title", key
    for flag in SINGLE_FLAGS:
        assert f"| {flag.name} |" in README, flag.name


def test_the_python_shown_runs(monkeypatch):
    (text,) = blocks("python")
    lines = [line for line in text.splitlines() if "tscorr.run(" not in line]
    monkeypatch.chdir(ROOT)
    exec(compile("\n".join(lines), "README.md", "exec"), {})


@pytest.mark.parametrize("word", re.findall(r"`tscorr (\w+)", README))
def test_every_command_named_exists(word):
    from tscorr.cli import cli

    assert word in cli.commands
