"""An object and a summary as HTML. All names are escaped: they come from models and files."""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from html import escape

from deworldsg_ros.base.words import counted
from deworldsg_ros.client.explain import explain_relation
from deworldsg_ros.client.objects import Relation, SceneObject, odds_of

# A second class is worth a word from this share of the first one's probability on, and as likely
# as the first from the other.
PERHAPS, AS_LIKELY = 0.1, 0.5
MOST_RELATIONS = 12
MUTED = "opacity:.65"


def in_words(item: SceneObject) -> str:
    """The class of an object as one would say it: "cup, or perhaps a bowl"."""
    if not item.classes:
        return item.label
    first = item.classes[0]
    if not item.is_named:
        return f"something, perhaps {_article(first.label)} {first.label}"
    others = [c for c in item.classes[1:] if c.probability >= PERHAPS * first.probability]
    likely = [c.label for c in others if c.probability >= AS_LIKELY * first.probability]
    if likely:
        rest = ", or something else" if item.other_classes > first.probability else ""
        return " or ".join([first.label, *likely[:2]]) + rest
    if others:
        return f"{first.label}, or perhaps {_article(others[0].label)} {others[0].label}"
    if item.other_classes > PERHAPS * first.probability:
        return f"{first.label}, or perhaps something else"
    return first.label


def uncertainty(item: SceneObject) -> str:
    """The entropy of the classes, in words; empty = not available."""
    if item.entropy_nats is None:
        return ""
    count = math.exp(item.entropy_nats)
    words = "certain" if count < 1.05 else f"like {count:.1f} equally likely classes"
    return f"{words} (entropy {item.entropy_nats:.2f} nats)"


def object_html(item: SceneObject, relations: Sequence[Relation], photo: bytes | None) -> str:
    """Everything about one object.

    Args:
        item: the object.
        relations: all of its relations, the most probable first.
        photo: JPEG of its best view; None = no image has shown it.
    """
    seconds = (item.last_seen_ns - item.first_seen_ns) / 1e9
    position = ", ".join(f"{value:.2f}" for value in item.position_m)
    size = " × ".join(item.size_words)
    unseen = "; not seen to the end: ≥" if item.is_partly_seen else ""
    facts = {
        f"is a {item.label}" if item.is_named else "is an object": (
            f"{item.probability:.0%} ({odds_of(item.probability)})"
        ),
        "exists": "" if item.existence is None else f"{item.existence:.0%}",
        "class": uncertainty(item),
        "looks": f"{counted(item.observations, 'frame')} over {seconds:.1f} s",
        "size": f"{size} cm (length, width, height{unseen})",
        "colour": item.colour or "",
        "place": f"{position} m",
    }
    return "".join(
        [
            '<div style="font-size:.85em;line-height:1.45;padding:0 .8em .4em">',
            f'<div style="font-size:1.15em"><b>{escape(item.name)}</b></div>',
            f'<div style="margin-bottom:.4em">{escape(in_words(item))}</div>',
            image_html(photo, "best view of the object"),
            _bars(item),
            _facts(facts),
            _relations(item, relations),
            "</div>",
        ]
    )


def image_html(jpeg_file: bytes | None, description: str) -> str:
    """An image of the page; empty without a file."""
    if not jpeg_file:
        return ""
    data = base64.b64encode(jpeg_file).decode()
    return (
        f'<img alt="{escape(description)}" style="max-width:100%;border-radius:4px;display:block;'
        f'margin:.3em 0" src="data:image/jpeg;base64,{data}">'
    )


def note_html(lines: Sequence[str]) -> str:
    """Lines of text above the scene's controls; the first one is emphasised."""
    first, *others = [escape(line) for line in lines] or [""]
    rest = "".join(f'<div style="{MUTED}">{line}</div>' for line in others)
    style = "font-size:.85em;line-height:1.45;padding:.2em .8em"
    return f'<div style="{style}"><b>{first}</b>{rest}</div>'


def _bars(item: SceneObject) -> str:
    shares = [(belief.label, belief.probability) for belief in item.classes]
    shares.append(("all other classes", item.other_classes))
    rows = [
        f'<tr><td style="padding-right:.6em">{escape(name)}</td>'
        f'<td style="width:45%"><div style="height:.7em;border-radius:2px;background:#3b6fb6;'
        f'width:{100 * min(share, 1.0):.1f}%"></div></td>'
        f'<td style="text-align:right">{share:.0%}</td></tr>'
        for name, share in shares
        if share >= 0.005
    ]
    caption = f'<caption style="{MUTED};text-align:left">if it exists</caption>'
    return f'<table style="width:100%;margin:.3em 0">{caption}{"".join(rows)}</table>'


def _facts(facts: dict[str, str]) -> str:
    rows = [
        f'<tr><td style="{MUTED};padding-right:.8em;vertical-align:top">{escape(name)}</td>'
        f"<td>{escape(text)}</td></tr>"
        for name, text in facts.items()
        if text
    ]
    return f'<table style="margin:.3em 0">{"".join(rows)}</table>'


def _relations(item: SceneObject, relations: Sequence[Relation]) -> str:
    if not relations:
        return f'<div style="{MUTED}">no relations</div>'
    parts = []
    for relation in relations[:MOST_RELATIONS]:
        text = relation.text.removeprefix(f"{item.name} ")
        lines = "".join(f"<div>{escape(line)}</div>" for line in explain_relation(relation).lines)
        parts.append(
            f'<details style="margin:.15em 0"><summary style="cursor:pointer">{escape(text)} '
            f'<span style="{MUTED}">{relation.probability:.0%}</span></summary>'
            f'<div style="{MUTED};padding-left:1.1em">{lines}</div></details>'
        )
    if len(relations) > MOST_RELATIONS:
        parts.append(f'<div style="{MUTED}">and {len(relations) - MOST_RELATIONS} more</div>')
    return f"<div><b>relations</b>{''.join(parts)}</div>"


def _article(noun: str) -> str:
    return "an" if noun[:1].lower() in "aeiou" else "a"
