"""Questions in words."""

import pytest

from deworldsg_ros.client import ClientError
from deworldsg_ros.client.questions import Condition, Pattern, Since, ask, parse

ON_TABLE, NEAR_CUP = Condition("on", "table"), Condition("near", "cup")


@pytest.mark.parametrize(
    ("question", "meaning"),
    [
        ("cup", Pattern("cup", ())),
        ("Where is the potted plant?", Pattern("potted plant", ())),
        ("cup on dining table", Pattern("cup", (Condition("on", "dining table"),))),
        ("which cup is standing on a table", Pattern("cup", (Condition("standing on", "table"),))),
        ("what is on the table", Pattern(None, (ON_TABLE,))),
        ("book on table and near cup", Pattern("book", (ON_TABLE, NEAR_CUP))),
        ("cat eating cake", Pattern("cat", (Condition("eating", "cake"),))),
        ("chair within 50 cm of table", Pattern("chair", (Condition(None, "table", None, 0.5),))),
        (
            "anything near (1, -2.5, .5) within 2m",
            Pattern(None, (Condition(None, None, (1.0, -2.5, 0.5), 2.0),)),
        ),
        ("cup near (0, 0, 0)", Pattern("cup", (Condition(None, None, (0.0, 0.0, 0.0), 1.0),))),
        ("cup near table within 1 m", Pattern("cup", (Condition(None, "table", None, 1.0),))),
        ("what changed since 10 s ago", Since(10.0, True)),
        ("what changed since 1750000005.5", Since(1750000005.5, False)),
        ("what changed?", Since(None, False)),
    ],
)
def test_patterns(question, meaning):
    assert parse(question, ["eating"]) == meaning


@pytest.mark.parametrize(
    ("question", "words"),
    [
        ("", "expected a class"),
        ("anything", "expected a class"),
        ("cup on", "at the end"),
        ("on table", "'on table'"),
        ("cup within", "''"),
        ("cup within far of table", "'far'"),
        ("cup within 1 m", "within what"),
        ("cup near (1, 2)", "no point"),
        ("cup on (1, 2, 3)", "near or within"),
        ("cup and cup", "'cup' is no condition"),
        ("what changed since yesterday", "10 s ago"),
    ],
)
def test_questions_that_cannot_be_read(question, words):
    with pytest.raises(ClientError) as refusal:
        parse(question)
    assert words in str(refusal.value)


def test_answers_carry_odds_evidence_and_doubt(room):
    first, *_ = ask(room, "cup on dining table").found
    assert first.item.name == "cup #13"
    assert first.is_sure
    (relation,) = first.relations
    parts = first.item.probability, relation.object.probability, relation.probability
    assert first.probability == pytest.approx(parts[0] * parts[1] * parts[2])
    assert "62 frames" in first.evidence

    doubtful = ask(room, "banana")
    assert [answer.is_sure for answer in doubtful.found] == [False]
    assert doubtful.found[0].item.label == "bowl"
    assert "'banana'" in doubtful.notes[0]

    nothing = ask(room, "elephant on table")
    assert nothing.found == () and nothing.notes


def test_distances_and_times(room):
    assert len(ask(room, "chair within 0.5 m of dining table").found) >= 3
    close = ask(room, "anything near (1.67, -0.5, 0.45) within 20 cm").found
    assert [answer.item.label for answer in close] == ["remote", "cup"][: len(close)]
    new = ask(room, "what changed since 5 s ago")
    assert all(room.stamp_ns - a.item.first_seen_ns <= 5e9 for a in new.found)
    assert 0 < len(new.found) < len(ask(room, "what changed").found) == len(room)
