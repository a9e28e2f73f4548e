"""Messages: one line that can be read, whatever was found."""

from ctm_plugin.errors import LONGEST, ConfigError, DataError, UnknownNameError


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
        assert len(str(error)) < 2 * LONGEST + 100
        assert "..." in str(error)
