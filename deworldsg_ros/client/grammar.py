"""The grammar of questions in words: "cup on dining table", "how many chairs", "the red mug"."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace
from typing import Literal

from deworldsg_ros.client.meanings import COLOUR_WORDS, KNOWN
from deworldsg_ros.client.objects import Point
from deworldsg_ros.scene.errors import ClientError
from deworldsg_ros.scene.limits import MAX_GRAPH_COORDINATE_M
from deworldsg_ros.scene.vocabulary import PREDICATES, plain

#     question  = "what changed" [ "since" time ] | "like" text
#               | [ "how many" | "is" | "what colour" ] pattern
#     pattern   = [ ordinal ] [ rank ] thing { [ "and" ] condition }
#     thing     = [ colour ] ( class | "anything" ) | colour
#     condition = [ "not" ] predicate thing [ "all the way up" ] | "near" point
#               | rank | nearest "to" ( thing | point )
#               | "within" length [ "of" ( thing | point ) ] | colour
#     colour    = "black", "white", "grey", "red", …
#     rank      = "largest", "smallest", "highest", … | nearest
#     nearest   = "closest" | "nearest" | "farthest"
#     ordinal   = "first", "second", "third", … of a rank; "from" alone means the closest
#     point     = "(" x "," y "," z ")"        length = number [ "m" | "cm" ]
#     time      = number [ "s" ] [ "ago" ]     a stamp in seconds, or seconds before the graph's
#     stamp
#
# "in the kitchen" is a condition with a room. A thing may be a room: "rooms next to the hall",
# "bedrooms with a desk". "which room is the cup in" is "room with cup".
#
# "what rests on the shelf, all the way up" has what is on the shelf, on that, and so on.
#
# Articles and words such as "which", "where", "there", "could you tell me" are skipped, and so is a
# last "in the room" or "here".

SKIPPED = frozenset(
    {
        *("a", "an", "the", "is", "are", "was", "which", "where", "find", "show", "all", "that"),
        *("there", "any", "me", "please", "do", "you", "i", "see", "can", "it", "one", "does"),
        *("could", "would", "tell", "know", "we", "us", "have", "got", "did", "leave", "put"),
        *("my", "our", "your", "this", "hey", "robot", "rests", "rest", "resting"),
    }
)
# After a support: also what rests on it by other things.
ALL_THE_WAY = ["all", "the", "way", "up"]
CONTRACTIONS = {
    **{f"{word}{s}": f"{word} is" for word in ("what", "where", "there") for s in ("'s", "s")},
    **{f"{word}{nt}": f"{word} not" for word in ("is", "are") for nt in ("n't", "nt")},
}
PLACES = frozenset({"room", "here", "view", "scene"})
# Relations with what carries or contains an object.
CARRYING = frozenset(PREDICATES[0] + PREDICATES[1])
# What people say for near.
NEAR_WORDS = frozenset({"next to", "beside", "close by", "close to", "around", "by"})
ANYTHING = frozenset(
    {
        "anything",
        "something",
        "everything",
        "what",
        "thing",
        "things",
        "object",
        "objects",
        "*",
        "?",
    }
)
# A person asks no longer question, and with no more conditions.
MAX_QUESTION, MAX_CONDITIONS = 500, 8
# What is compared, and whether most of it comes first.
RANKS = {
    **dict.fromkeys(("largest", "biggest"), ("size", True)),
    "smallest": ("size", False),
    "tallest": ("height", True),
    **dict.fromkeys(("highest", "topmost"), ("place", True)),
    "lowest": ("place", False),
    **dict.fromkeys(("closest", "nearest"), ("distance", False)),
    **dict.fromkeys(("farthest", "furthest"), ("distance", True)),
}

ORDINALS = {"first": 1, "second": 2, "third": 3, "fourth": 4, "fifth": 5, "2nd": 2, "3rd": 3}

Kind = Literal["find", "count", "exists", "holds", "colour"]

_TOKEN = re.compile(r"\([^()]*\)|[^\s,()]+|[()]")
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_LENGTH = re.compile(rf"({_NUMBER})(cm|m)?")


@dataclass(frozen=True)
class Condition:
    """Conditions on an object.

    Attributes:
        predicate: of a relation; None = a distance only.
        thing: class of the other object; None = anything.
        point: a place instead of an object.
        within_m: largest distance, metres.
        is_negated: whether it has to be false.
        colour: of the other object; None = any.
        own_colour: of the object itself; there is nothing else then.
        all_the_way: whether other things may be between the object and what it rests on.
    """

    predicate: str | None = None
    thing: str | None = None
    point: Point | None = None
    within_m: float | None = None
    is_negated: bool = False
    colour: str | None = None
    own_colour: str | None = None
    all_the_way: bool = False


@dataclass(frozen=True)
class Rank:
    """The order of the answers; only the first one is meant, or a later one.

    Attributes:
        word: of `RANKS`.
        thing: what is near; None = the point, or nothing.
        point: what is near.
        colour: of the thing; None = any.
        place: of the one that is meant, from 1.
    """

    word: str
    thing: str | None = None
    point: Point | None = None
    colour: str | None = None
    place: int = 1


@dataclass(frozen=True)
class Pattern:
    """A question for objects.

    Attributes:
        thing: class; None = anything.
        conditions: all of them have to hold.
        kind: ``find``, ``count`` ("how many"), ``exists`` ("is there a cup"), ``holds`` ("is the
            cup on …": of the most probable cup, which counts as certain), or ``colour`` ("what
            colour is the cup").
        rank: the order of the answers; None = the most probable first.
    """

    thing: str | None
    conditions: tuple[Condition, ...]
    kind: Kind = "find"
    rank: Rank | None = None


@dataclass(frozen=True)
class Since:
    """A question for changes.

    Attributes:
        time_s: a stamp in seconds, or seconds before the graph's stamp; None = the first graph.
        ago: whether `time_s` counts back from the graph's stamp.
    """

    time_s: float | None
    ago: bool


@dataclass(frozen=True)
class Like:
    """A question for objects that look like a text.

    Attributes:
        text: in any words.
    """

    text: str


def parse(question: str, predicates: Collection[str] = ()) -> Pattern | Since | Like:
    """Read a question.

    Args:
        question: see the top of this file.
        predicates: further predicates, e.g. those of the graph.

    Raises:
        ClientError: if it cannot be read.
    """
    if len(question) > MAX_QUESTION:
        raise ClientError(
            f"question of {len(question)} characters: expected at most {MAX_QUESTION}"
        )
    text = question.strip().rstrip(" ?.!").lower().replace("’", "'")
    words = [CONTRACTIONS.get(word, word) for word in text.split()]
    tokens = _TOKEN.findall(" ".join(words))
    if tokens[:2] == ["what", "changed"]:
        return _since(question, tokens[2:])
    if tokens[:1] == ["like"]:
        return Like(question.split(maxsplit=1)[1].strip("\"'“” ") if tokens[1:] else "")
    all_the_way = tokens[-len(ALL_THE_WAY) :] == ALL_THE_WAY
    tokens = tokens[: -len(ALL_THE_WAY)] if all_the_way else tokens
    kind: Kind = "find"
    if tokens[:2] == ["how", "many"]:
        kind, tokens = "count", tokens[2:]
    elif tokens[:1] in (["is"], ["are"]):
        kind = "holds" if tokens[1:2] == ["the"] else "exists"
    tokens = [token for token in tokens if token not in SKIPPED]
    if len(tokens) > 1 and tokens[-1] in PLACES and (tokens[-2] == "in" or tokens[-1] != "room"):
        tokens = tokens[: -2 if tokens[-2] == "in" else -1]
    asked = tokens[1:] if tokens[:1] == ["what"] else tokens
    if asked[:1] == ["room"] and asked[-1] == "in":
        tokens = ["room", "with", *asked[1:-1]]
    elif asked[:2] == ["in", "room"]:
        tokens = ["room", "with", *asked[2:]]
    if tokens[:2] in (["what", "colour"], ["what", "color"]):
        kind, tokens = "colour", tokens[3:] if tokens[2:3] == ["of"] else tokens[2:]
    pattern = _Reader(question, tokens, _longest_first(predicates)).pattern(kind)
    return _all_the_way(question, pattern) if all_the_way else pattern


def _all_the_way(question: str, pattern: Pattern) -> Pattern:
    """The pattern with its last condition all the way up."""
    *others, last = pattern.conditions or (Condition(),)
    if last.predicate not in CARRYING:
        raise ClientError(
            f"question '{question}': expected 'on' or 'in' and a thing before 'all the way up'"
        )
    return replace(pattern, conditions=(*others, replace(last, all_the_way=True)))


class _Reader:
    """Takes the tokens of a pattern from the left."""

    def __init__(self, question: str, tokens: list[str], names: list[list[str]]) -> None:
        self.question = question
        self.tokens = tokens
        self.names = names

    def pattern(self, kind: Kind) -> Pattern:
        ordinal = self.tokens.pop(0) if self.tokens[:1] and self.tokens[0] in ORDINALS else None
        rank = self.tokens.pop(0) if self.tokens[:1] and self.tokens[0] in RANKS else None
        thing, colour = self.thing()
        ranks = [] if rank is None else [self._rank(rank)]
        conditions = [] if colour is None else [Condition(own_colour=colour)]
        while self.tokens:
            if thing is None and self.tokens[0] in ANYTHING:  # "what is the largest thing"
                self.tokens.pop(0)
            elif self.tokens[0] in RANKS:
                ranks.append(self._rank(self.tokens.pop(0)))
            elif ordinal is not None and not ranks and self.tokens[0] in ("from", "to"):
                ranks.append(self._rank("closest"))
            else:
                conditions.append(self.condition())
        conditions = list(dict.fromkeys(conditions))  # said twice, it counts once
        if len(conditions) > MAX_CONDITIONS:
            raise ClientError(
                f"question '{self.question}': {len(conditions)} conditions: expected at most "
                f"{MAX_CONDITIONS}"
            )
        if thing is None and not conditions and not ranks:
            raise ClientError(f"question '{self.question}': expected a class, as in 'cup on table'")
        if len(ranks) > 1:
            words = " and ".join(found.word for found in ranks)
            raise ClientError(f"question '{self.question}': {words}: expected one of them")
        if ordinal is not None:
            if not ranks:
                raise ClientError(
                    f"question '{self.question}': {ordinal} in which order? expected a word such "
                    "as largest, or 'from' and a thing or a point"
                )
            ranks[0] = replace(ranks[0], place=ORDINALS[ordinal])
        if kind == "holds" and not conditions:
            kind = "exists"
        return Pattern(thing, tuple(conditions), kind, ranks[0] if ranks else None)

    def _rank(self, word: str) -> Rank:
        if RANKS[word][0] != "distance":
            return Rank(word)
        if self.tokens[:1] in (["to"], ["from"], ["of"]):
            self.tokens.pop(0)
            if self.tokens and self.tokens[0].startswith("("):
                return Rank(word, None, self._point())
            thing, colour = self.thing()
            return Rank(word, thing, None, colour)
        raise ClientError(
            f"question '{self.question}': {word} to what? expected 'to' and a thing or a point"
        )

    def thing(self) -> tuple[str | None, str | None]:
        """A class (None = anything) and its colour (None = any)."""
        colour, words = self._colour(), list[str]()
        # After a thing, a colour is said of it.
        while self.tokens and not (self._at_condition() or words and self._is_colour()):
            words.append(self.tokens.pop(0))
        name = " ".join(word for word in words if word not in ANYTHING)
        if words or colour is not None:
            return name or None, colour
        raise ClientError(
            f"question '{self.question}': expected a class or 'anything' "
            + (f"before '{' '.join(self.tokens)}'" if self.tokens else "at the end")
        )

    def _colour(self) -> str | None:
        """Take a leading colour; None for an orange, and if there is none."""
        if not self.tokens or not self._is_colour():
            return None
        ends = len(self.tokens) == 1 or self._at_condition(1) or self._is_colour(1)
        if self.tokens[0] in KNOWN and ends:
            return None
        return COLOUR_WORDS[self.tokens.pop(0)]

    def _is_colour(self, at: int = 0) -> bool:
        return self.tokens[at] in COLOUR_WORDS

    def condition(self) -> Condition:
        if self.tokens[0] == "and":
            self.tokens.pop(0)
        if self.tokens[:1] == ["not"]:
            self.tokens.pop(0)
            if not self.tokens:
                raise ClientError(f"question '{self.question}': not what? expected a condition")
            return replace(self.condition(), is_negated=True)
        if self.tokens and self._is_colour():
            return Condition(own_colour=COLOUR_WORDS[self.tokens.pop(0)])
        if self.tokens[:1] == ["within"]:
            return self._within(None, None)
        predicate = self._predicate()
        if predicate in NEAR_WORDS:
            predicate = "near"
        if predicate is None:
            raise ClientError(
                f"question '{self.question}': '{' '.join(self.tokens) or 'the end'}' is no "
                "condition; expected a predicate such as on, near or within, or a colour"
            )
        if self.tokens and self.tokens[0].startswith("("):
            if predicate != "near":
                raise ClientError(f"question '{self.question}': a point needs near or within")
            return self._within(None, self._point())
        thing, colour = self.thing()
        if predicate == "near" and self.tokens[:1] == ["within"]:
            return self._within(thing, None, colour)
        return Condition(predicate, thing, colour=colour)

    def _within(
        self, thing: str | None, point: Point | None, colour: str | None = None
    ) -> Condition:
        """The rest of a distance; without a length, near a point means 1 m."""
        length_m = 1.0
        if self.tokens[:1] == ["within"]:
            self.tokens.pop(0)
            length_m = self._length()
            if self.tokens[:1] == ["of"]:
                self.tokens.pop(0)
                if self.tokens and self.tokens[0].startswith("("):
                    point = self._point()
                else:
                    thing, colour = self.thing()
        if thing is None and point is None and colour is None:
            raise ClientError(f"question '{self.question}': within what? expected 'of' and a thing")
        return Condition(None, thing, point, length_m, colour=colour)

    def _length(self) -> float:
        text = self.tokens.pop(0) if self.tokens else ""
        match = _LENGTH.fullmatch(text)
        if match is None:
            raise ClientError(f"question '{self.question}': '{text}' is no length such as 0.5 m")
        unit = match[2] or (self.tokens.pop(0) if self.tokens[:1] in (["m"], ["cm"]) else "m")
        return self._metres(float(match[1]) * (0.01 if unit == "cm" else 1.0))

    def _metres(self, value: float) -> float:
        if not abs(value) <= MAX_GRAPH_COORDINATE_M:
            most = f"at most {MAX_GRAPH_COORDINATE_M:g} m"
            raise ClientError(f"question '{self.question}': {value:g} m: expected {most}")
        return value

    def _point(self) -> Point:
        text = self.tokens.pop(0)
        numbers = re.findall(_NUMBER, text)
        if len(numbers) != 3:
            raise ClientError(f"question '{self.question}': '{text}' is no point (x, y, z)")
        x, y, z = (self._metres(float(number)) for number in numbers)
        return x, y, z

    def _at_condition(self, at: int = 0) -> bool:
        token = self.tokens[at]
        is_end = token in ("and", "not", "within", "to", "from") or token in RANKS
        return is_end or self._match(at) is not None

    def _match(self, at: int = 0) -> list[str] | None:
        return next((n for n in self.names if self.tokens[at : at + len(n)] == n), None)

    def _predicate(self) -> str | None:
        name = self._match()
        if name is None:
            return None
        del self.tokens[: len(name)]
        return " ".join(name)


def _longest_first(predicates: Iterable[str]) -> list[list[str]]:
    names = {plain(name) for group in PREDICATES for name in group} | set(map(plain, predicates))
    names |= NEAR_WORDS
    return sorted((name.split() for name in names if name), key=lambda n: (-len(n), n))


def _since(question: str, tokens: list[str]) -> Since:
    match = re.fullmatch(rf"(?:since ({_NUMBER}) ?s?( ago)?)?", " ".join(tokens))
    if match is None:
        raise ClientError(
            f"question '{question}': expected 'what changed since 10 s ago' or a stamp in seconds"
        )
    return Since(None if match[1] is None else float(match[1]), match[2] is not None)
