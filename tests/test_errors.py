"""Messages: one line that can be read, whatever was found; Ctrl-C held back."""

import signal

import pytest

from ctm_plugin.errors import MAX_CHARACTERS, ConfigError, DataError, UnknownNameError, held_interrupt


def test_control_characters_are_escaped():
    """A terminal would obey them, and some encodings have no lone surrogates."""
    message = str(DataError("a\nb", "x\x1b[31m\ud800", "é, 漢字"))
    assert message == r"a\nb: found x\x1b[31m\ud800, expected é, 漢字"


def test_what_is_long_is_cut():
    for error in (
        DataError("p" * 5000, "f" * 5000, "e"),
        ConfigError("k", [0] * 5000, "e"),
        UnknownNameError("k", "x" * 5000, ["n"]),
    ):
        assert len(str(error)) < 2 * MAX_CHARACTERS + 100
        assert "..." in str(error)


def pressed_in_the_middle(done: list[str]) -> None:
    with held_interrupt():
        signal.raise_signal(signal.SIGINT)
        done.append("the rest of the block")


def test_ctrl_c_waits_for_the_end_of_a_block():
    done, before = [], signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        pressed_in_the_middle(done)
    assert done
    assert signal.getsignal(signal.SIGINT) is before
    with pytest.raises(ZeroDivisionError), held_interrupt():
        raise ZeroDivisionError
    assert signal.getsignal(signal.SIGINT) is before
