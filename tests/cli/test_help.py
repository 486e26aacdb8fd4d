"""The manual: made from the parser, so that it cannot miss an option."""

from __future__ import annotations

import pytest

from servofd.cli import build_parser, main
from servofd.cli.options import VERBS, WAYS
from servofd.servo.faults import FAULTS


@pytest.mark.parametrize("verb", VERBS)
def test_help_of_a_verb_is_what_its_option_prints(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main([verb, "--help"])
    shown = capsys.readouterr().out
    assert main(["help", verb]) == 0
    assert capsys.readouterr().out == shown
    assert shown.startswith(f"usage: servofd {verb}")
    assert "%%" not in shown


def test_help_of_simulate_names_every_fault_that_it_makes(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["help", "simulate"]) == 0
    words = capsys.readouterr().out.replace(",", " ").split()
    assert set(FAULTS) <= set(words)


def test_help_alone_lists_every_verb(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["help"]) == 0
    assert capsys.readouterr().out == build_parser().format_help()


def test_help_fits_a_screen(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["help"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) < 24
    assert max(map(len, lines)) <= 80
    assert len(VERBS) <= 15


@pytest.mark.parametrize("old", WAYS)
def test_an_old_spelling_works_and_says_the_new_one(old: str, capsys: pytest.CaptureFixture[str]) -> None:
    verb, option, *_ = WAYS[old]
    for words in ([old, "--help"], [verb, option, "--help"]):
        with pytest.raises(SystemExit) as ended:
            main(words)
        assert ended.value.code == 0
        printed = capsys.readouterr()
        assert printed.out.startswith(f"usage: servofd {verb} {option} ")
        says = [f"servofd: 'servofd {old}' is now 'servofd {verb} {option}'"] if words[0] == old else []
        assert printed.err.splitlines() == says
    with pytest.raises(SystemExit):
        main([verb, "--help"])
    assert option in capsys.readouterr().out


def test_an_unknown_verb_is_one_line_with_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["help", "audti"]) == 2
    assert "unknown verb 'audti'; did you mean audit?" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "hint"),
    [
        (["compare", "a.rrd", "b.rrd"], "servofd review A.rrd --compare B.rrd"),
        (["info", "s3://bucket/flight.bin"], "is an address, which only `servofd audit` and `servofd trend` read"),
    ],
)
def test_what_another_verb_does_is_said_in_one_line(
    words: list[str], hint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        code = main(words)
    except SystemExit as ended:
        code = int(str(ended.code))
    assert code == 2
    said = capsys.readouterr().err
    assert hint in said
    assert said.count("\n") == 1
