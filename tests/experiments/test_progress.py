"""Progress as a bar on a terminal, as lines elsewhere, or not at all."""

from __future__ import annotations

import io
import sys

import pytest

from jaxpomdp.experiments.progress import Progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def shown(stream, kind="auto", **settings) -> str:
    with Progress("maze", 10, kind, stream, **settings) as bar:
        bar.say("resuming")
        for done in (4, 10):
            bar.update(done, f"goal {done} %")
    return stream.getvalue()


def test_a_terminal_sees_a_bar():
    text = shown(Terminal())
    assert "resuming\n" in text
    assert "10/10" in text
    assert "goal 10 %" in text
    assert "\r" in text


@pytest.mark.parametrize("stream", [io.StringIO, Terminal])
def test_without_a_terminal_or_tqdm_there_are_lines(stream, monkeypatch):
    monkeypatch.setitem(sys.modules, "tqdm", None)
    lines = shown(stream(), seconds=0).splitlines()
    assert lines[0] == "resuming"
    assert lines[1].startswith("maze 4/10 [0 s] goal 4 %")
    assert len(lines) == 3


def test_lines_come_now_and_then_and_at_the_end():
    assert len(shown(io.StringIO(), seconds=1000).splitlines()) == 2


def test_none_says_nothing():
    assert shown(Terminal(), "none") == ""
