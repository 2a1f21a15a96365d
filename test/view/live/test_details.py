"""The details of an object, in words, and as HTML that nothing can escape from."""

from __future__ import annotations

import math

import pytest
from support.view import make_edge, make_node

from deworldsg_ros.client.objects import relation_of, scene_object
from deworldsg_ros.view.live.details import in_words, note_html, object_html, uncertainty
from deworldsg_ros.wire import messages as wire

UP = (0.0, 0.0, 1.0)


def item(*classes, remainder=0.0, entropy=None):
    node = make_node(13, classes[0][0] if classes else "cup")
    beliefs = [wire.Belief(label, probability) for label, probability in classes]
    values = {name: getattr(node, name) for name in node.__struct_fields__}
    values |= {"classes": beliefs, "remainder": remainder, "entropy_nats": entropy}
    return scene_object(wire.NodeState(**values), "map", UP)


@pytest.mark.parametrize(
    ("classes", "remainder", "words"),
    [
        ([], 0.0, "cup"),
        ([("cup", 0.97), ("bowl", 0.03)], 0.0, "cup"),
        ([("cup", 0.8), ("bowl", 0.2)], 0.0, "cup, or perhaps a bowl"),
        ([("cup", 0.8), ("orange", 0.2)], 0.0, "cup, or perhaps an orange"),
        ([("cup", 0.5), ("bowl", 0.45)], 0.05, "cup or bowl"),
        ([("cup", 0.2), ("bowl", 0.2), ("vase", 0.2)], 0.4,
         "cup or bowl or vase, or something else"),
        ([("cup", 0.7)], 0.3, "cup, or perhaps something else"),
    ],
)  # fmt: skip
def test_doubt_is_said_in_words(classes, remainder, words):
    assert in_words(item(*classes, remainder=remainder)) == words


def test_entropy_is_a_number_of_classes():
    assert "2.0 equally likely" in uncertainty(item(("cup", 0.5), entropy=math.log(2)))
    assert uncertainty(item(("cup", 1.0), entropy=0.0)).startswith("certain")
    assert uncertainty(item(("cup", 1.0))) == ""


def test_all_that_is_known_is_there():
    cup = item(("cup", 0.7), ("bowl", 0.2), remainder=0.1, entropy=0.8)
    table = scene_object(make_node(5, "table"), "map", UP)
    html = object_html(cup, [relation_of(make_edge(13, 5), cup, table, None)], b"\xff\xd8jpeg")
    for text in (
        "cup #13", "bowl", "all other classes", "10%", "5 frames", "on table #5", "80%",
        "seen in 4 frames", "data:image/jpeg;base64,/9hqcGVn",
    ):  # fmt: skip
        assert text in html, text


@pytest.mark.parametrize("name", ["<script>alert(1)</script>", '"><img src=x onerror=1>', "&lt;"])
def test_names_are_text(name):
    evil = item((name, 0.5), (name + "2", 0.4), remainder=0.1)
    html = object_html(evil, [relation_of(make_edge(13, 13, name), evil, evil, None)], None)
    html += note_html([name, name])
    assert name not in html
    assert "<script" not in html and "<img" not in html
