"""Questions in words."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import typer.testing

from deworldsg_ros.cli.app import app
from deworldsg_ros.client import ClientError, SceneGraph
from deworldsg_ros.client.questions import Condition, Pattern, Since, ask, parse


@pytest.mark.parametrize(
    ("question", "meaning"),
    [
        ("cup", Pattern("cup", ())),
        ("Where is the potted plant?", Pattern("potted plant", ())),
        ("cup on dining table", Pattern("cup", (Condition("on", "dining table"),))),
        ("which cup is standing on a table", Pattern("cup", (Condition("standing on", "table"),))),
        ("what is on the table", Pattern(None, (Condition("on", "table"),))),
        (
            "book on table and near cup",
            Pattern("book", (Condition("on", "table"), Condition("near", "cup"))),
        ),
        (
            "chair within 50 cm of table",
            Pattern("chair", (Condition(None, "table", None, 0.5),)),
        ),
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
def test_patterns(question: str, meaning: object) -> None:
    assert parse(question) == meaning


@pytest.mark.parametrize(
    ("question", "words"),
    [
        ("", "expected a class"),
        ("anything", "expected a class, as in"),
        ("cup on", "at the end"),
        ("on table", "before 'on table'"),
        ("cup within", "'' is no length"),
        ("cup within far of table", "'far' is no length"),
        ("cup within 1 m", "within what?"),
        ("cup near (1, 2)", "is no point"),
        ("cup on (1, 2, 3)", "a point needs near or within"),
        ("cup and cup", "'cup' is no condition"),
        ("what changed since yesterday", "what changed since 10 s ago"),
    ],
)
def test_questions_that_cannot_be_read(question: str, words: str) -> None:
    with pytest.raises(ClientError) as refusal:
        parse(question)
    assert words in str(refusal.value)


def test_further_predicates_of_the_graph_are_known() -> None:
    assert parse("cat eating cake", ["eating"]) == Pattern("cat", (Condition("eating", "cake"),))


def test_answers_carry_odds_evidence_and_doubt(room: SceneGraph) -> None:
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
    assert "no object of class 'banana'" in doubtful.notes[0]

    nothing = ask(room, "elephant on table")
    assert nothing.found == ()
    assert nothing.notes[0].startswith("nothing fulfils this")


def test_distances_and_times(room: SceneGraph) -> None:
    chairs = ask(room, "chair within 0.5 m of dining table").found
    assert len(chairs) >= 3
    close = ask(room, "anything near (1.67, -0.5, 0.45) within 20 cm").found
    assert [answer.item.label for answer in close] == ["remote", "cup"][: len(close)]
    new = ask(room, "what changed since 5 s ago")
    assert all(room.stamp_ns - a.item.first_seen_ns <= 5e9 for a in new.found)
    assert 0 < len(new.found) < len(ask(room, "what changed").found) == len(room)


def run(*arguments: object) -> typer.testing.Result:
    return typer.testing.CliRunner().invoke(app, list(map(str, arguments)))


def test_the_commands_print_tables_and_json(demo_out: Path) -> None:
    table = run("query", demo_out, "cup", "on", "dining", "table")
    assert table.exit_code == 0
    assert "cup #13" in table.stdout
    answers = json.loads(run("query", demo_out, "banana", "--json").stdout)
    assert answers["answers"][0]["sure"] is False
    assert answers["answers"][0]["odds"].startswith("1 : ")
    assert "not sure" in run("query", demo_out, "banana").stdout

    goal = json.loads(run("goal", demo_out, "cup", "--json").stdout)
    assert set(goal["pose"]) == {"position", "orientation"}
    assert "stand at" in run("goal", demo_out, "13", "--distance", "0.8").stdout

    assert "seen, and judged" in run("explain", demo_out, "13", "5").stdout
    assert json.loads(run("explain", demo_out, "elephant", "--json").stdout)["hidden"] == []


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["query", "nowhere", "cup"], "cannot be read"),
        (["query", "demo_out"], "expected a graph and a question"),
        (["query", "demo_out", "cup on"], "expected a class"),
        (["goal", "demo_out", "elephant"], "no object of class 'elephant'"),
        (["goal", "demo_out", "cup", "--distance", "-1"], "expected a positive number"),
        (["explain", "demo_out", "99"], "object 99 is not in the graph"),
    ],
)
def test_errors_are_one_sentence(demo_out: Path, arguments: list[str], words: str) -> None:
    result = run(*arguments)
    assert result.exit_code == 2
    assert words in result.stderr
    assert "Traceback" not in result.stderr
