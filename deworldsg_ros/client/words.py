"""Names of classes and predicates as people write them."""

from __future__ import annotations

from deworldsg_ros.scene.predicates import PREDICATES, plain


def words_of(name: str) -> list[str]:
    """The words of a name in lower case; hyphens and underscores separate words."""
    return plain(name).replace("-", " ").split()


def is_class(asked: str, label: str) -> bool:
    """Whether a name means a class: "table" and "tables" mean "table" and "dining table"."""
    wanted, known = words_of(asked), words_of(label)
    if not wanted or len(wanted) > len(known):
        return False
    return any(form == known[-len(form) :] for form in _singular_forms(wanted))


def _singular_forms(words: list[str]) -> list[list[str]]:
    *first, last = words
    forms = [last]
    if last.endswith("ies"):
        forms.append(last[:-3] + "y")
    if last.endswith("ves"):
        forms.append(last[:-3] + "f")
    if last.endswith("es"):
        forms.append(last[:-2])
    if last.endswith("s"):
        forms.append(last[:-1])
    return [[*first, form] for form in forms]


def predicate_names(asked: str) -> frozenset[str]:
    """The predicates that a name means: "on" means every way to be on something."""
    name = " ".join(words_of(asked))
    for names in PREDICATES:
        if name == names[0]:
            return frozenset(names)
    return frozenset({name})
