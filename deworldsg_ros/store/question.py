"""Which Cypher is a question: reading only holds for the database, not for other files."""

from __future__ import annotations

import re

from deworldsg_ros.store.errors import StoreError

FIRST_WORDS = ("MATCH", "OPTIONAL", "WITH", "UNWIND", "RETURN")
# They read or write files, change settings of the database, or change what is in it.
REFUSED_WORDS = frozenset(
    (
        "ALTER",
        "ATTACH",
        "CALL",
        "COPY",
        "CREATE",
        "DROP",
        "EXPORT",
        "IMPORT",
        "INSTALL",
        "LOAD",
        "USE",
    )
)

# What is in quotes is no word of the language, and no comment.
_QUOTED = r"""'(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*"|`[^`]*`"""
_COMMENT = r"/\*.*?\*/|//[^\r\n]*"
_QUOTED_OR_COMMENT = re.compile(f"(?P<quoted>{_QUOTED})|{_COMMENT}", re.DOTALL)
# As ladybug reads it: "1LOAD" is a number and a word.
_WORD = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


def checked_question(cypher: str) -> str:
    """A question without its comments; only this text was checked, so it has to be the one to ask.

    Raises:
        StoreError: it is no question, but a statement that may use files or change something.
    """
    question = _QUOTED_OR_COMMENT.sub(lambda found: found["quoted"] or " ", cypher)
    plain = _QUOTED_OR_COMMENT.sub(" ", question)
    words = [word.upper() for word in _WORD.findall(plain)]
    first = words[0] if words else ""
    if first not in FIRST_WORDS:
        raise _refusal(f"it begins with '{first}': expected {', '.join(FIRST_WORDS)}")
    refused = sorted(REFUSED_WORDS.intersection(words))
    if refused:
        raise _refusal(f"{refused[0]} is no part of a question; a name can be in backticks")
    if ";" in plain.rstrip().removesuffix(";"):
        raise _refusal("it has more than one statement: ask one at a time")
    return question


def _refusal(problem: str) -> StoreError:
    return StoreError(f"the question cannot be answered: {problem}")
