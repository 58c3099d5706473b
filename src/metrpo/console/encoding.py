"""Printing where the terminal, pipe or log is not Unicode: its encoding may not cost a finished run its last words."""

from __future__ import annotations

import codecs
import sys
import unicodedata

_NAME = "metrpo-plain"
_SUBSTITUTES = {
    "±": "+-",
    "×": "x",
    "∞": "inf",
    "•": "*",
    "·": ".",
    "…": "...",
    "√": "sqrt",
    "Δ": "delta ",
    **dict.fromkeys("–—−─━╌╍╸╺", "-"),
    **dict.fromkeys("│┃║", "|"),
    **dict.fromkeys("╭╮╰╯┌┐└┘├┤┬┴┼╔╗╚╝", "+"),
    **dict.fromkeys("‘’", "'"),
    **dict.fromkeys("“”„", '"'),
    **dict.fromkeys("→⇒", "->"),
    **dict.fromkeys("←⇐", "<-"),
    # a curve of blocks, from low to high
    **dict(zip("▁▂▃▄▅▆▇█", "_.,-=+*#", strict=True)),
}


def print_anywhere() -> None:
    """Lets stdout and stderr print every text: what their encoding lacks becomes ASCII of about the same meaning."""
    codecs.register_error(_NAME, _plainly)
    for stream in (sys.stdout, sys.stderr):
        reconfigure = getattr(stream, "reconfigure", None)  # a notebook's streams take every text as they are
        if reconfigure is not None:
            reconfigure(errors=_NAME)


def _plainly(error: UnicodeError) -> tuple[str | bytes, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    wanted = error.object[error.start : error.end]
    return "".join(_in_ascii(character) for character in wanted), error.end


def _in_ascii(character: str) -> str:
    if character in _SUBSTITUTES:
        return _SUBSTITUTES[character]
    if 0xDC80 <= ord(character) <= 0xDCFF:  # a byte of a file name that was no text
        return f"\\x{ord(character) - 0xDC00:02x}"
    if 0x2800 <= ord(character) <= 0x28FF:  # a wheel of dots that turns
        return "*"
    letters = unicodedata.normalize("NFKD", character).encode("ascii", "ignore").decode()
    return letters or "?"
