"""What README and docs type into a terminal exists, and what they link to is there."""

from __future__ import annotations

import re
from pathlib import Path
from urllib.parse import unquote

import pytest
from typer.main import get_command

from insideout.core.cli import app

_ROOT = Path(__file__).resolve().parents[2]
_TEXTS = [_ROOT / "README.md", _ROOT / "CHANGELOG.md", *sorted((_ROOT / "docs").glob("*.md"))]


@pytest.fixture(params=_TEXTS, ids=lambda path: path.name)
def text(request):
    return request.param.read_text("utf-8")


def _commands(text):
    """Command lines of `insideout`, in blocks or between backticks."""
    joined = text.replace("\\\n", " ")
    names = "|".join(get_command(app).commands)
    return re.findall(rf"\binsideout ((?:{names})\b[^`\n]*)", joined)


def test_commands_and_options_exist(text):
    for line in _commands(text):
        words = line.split("#")[0].split()
        command = get_command(app).commands[words.pop(0)]
        if hasattr(command, "commands") and words and not words[0].startswith("-"):
            assert words[0] in command.commands, line
            command = command.commands[words[0]]
        known = {option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)}
        assert {word for word in words if word.startswith("--")} <= known | {"--help"}, line


def test_options_named_alone_are_of_some_command(text):
    groups = [get_command(app), *(one for one in get_command(app).commands.values() if hasattr(one, "commands"))]
    commands = [command for group in groups for command in group.commands.values()]
    known = {option for command in commands for one in command.params for option in (*one.opts, *one.secondary_opts)}
    for example in (_ROOT / "examples").glob("*.py"):
        known |= set(re.findall(r"add_argument\(\s*\"(--[\w-]+)\"", example.read_text("utf-8")))
    assert set(re.findall(r"`(--[\w-]+)", text)) <= known | {"--help"}


def test_links_lead_somewhere(request, text):
    here = request.node.callspec.params["text"].parent
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if link.startswith(("http://", "https://")):
            continue
        name, _, heading = unquote(link).partition("#")
        target = here / name
        assert target.is_file(), link
        if heading:
            headings = re.findall(r"^#+ (.*)$", target.read_text("utf-8"), re.M)
            assert heading in {_anchor(title) for title in headings}, link


def _anchor(title):
    """As GitHub makes them."""
    return re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")


def test_scripts_and_folders_that_are_named_exist(text):
    for name in re.findall(r"\b(?:examples|samples)/\w[\w/]*(?:\.py)?", text):
        assert (_ROOT / name).exists(), name
