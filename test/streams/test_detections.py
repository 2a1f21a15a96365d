"""Detections of another process: JSON and vision_msgs give the same; what is refused is named."""

import math

import msgspec
import numpy as np
import pytest
from support.detections import vision_message, wire_message

from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.streams.detections import read_detections, sent_detections
from deworldsg_ros.wire import messages as wire

BOX, OTHER = [2.0, 1.0, 6.0, 4.0], [0.0, 0.0, 3.0, 2.0]
NAMED = [(BOX, {"red mug": 0.6, "cup": 0.3}), (OTHER, {"desk": 0.9})]


def one(**changes):
    """A message of one object, with changes."""
    message = wire_message([(BOX, {"mug": 0.5})], embedding_model="clip")
    message.detections = [msgspec.structs.replace(message.detections[0], **changes)]
    return message


def mask_of(pixels, left=0, top=0):
    bits = np.packbits(pixels > 0).tobytes()
    return wire.SentMask(left, top, pixels.shape[1], pixels.shape[0], bits)


def test_json_and_vision_msgs_say_the_same():
    sent = sent_detections(read_detections(vision_message(NAMED)), 8, 6)
    text = type("String", (), {"data": wire.encode(wire_message(NAMED))})()
    again = sent_detections(read_detections(text), 8, 6)
    for got in (sent, again):
        assert got.boxes_xyxy.tolist() == [BOX, OTHER] and got.scores.tolist() == [0.6, 0.9]
        assert got.names == (("red mug", "cup"), ("desk",)) and got.masks is None
        assert got.name_scores == ((0.6, 0.3), (0.9,))


def test_the_example_of_the_schema_is_read(root_dir):
    text = (root_dir / "msg_schemas" / "detections.example.json").read_text()
    sent = sent_detections(wire.decode(text, wire.DetectionsMessage), 640, 480)
    assert sent.names[0] == ("red mug", "cup") and len(sent.masks) == len(sent.embeddings) == 2


def test_a_turned_box_becomes_the_upright_one_around_it():
    (item,) = read_detections(vision_message(NAMED[:1], theta=math.pi / 2)).detections
    assert np.allclose(item.box_xyxy, [2.5, 0.5, 5.5, 4.5])
    # A detection without a result says nothing.
    assert read_detections(vision_message([(BOX, {})])).detections == []


def test_masks_and_embeddings_arrive_to_the_bit():
    rng = np.random.default_rng(0)
    pixels, values = rng.random((3, 4)) < 0.5, rng.normal(size=5).astype("<f2")
    sent = sent_detections(one(mask=mask_of(pixels, 4, 3), embedding=values.tobytes()), 8, 6)
    (mask,) = sent.masks
    assert (mask.left, mask.top) == (4, 3) and (mask.pixels == pixels).all()
    assert (sent.embeddings == values.astype(np.float32)).all()
    instances = np.zeros((6, 8), np.uint16)
    instances[2:4, 3:5], instances[0, 0] = 1, 1  # the second place is outside of the box
    (mask,) = sent_detections(one(), 8, 6, instances).masks
    assert mask.pixels.sum() == 4 and mask.pixels[2 - mask.top : 4 - mask.top].any()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"box_xyxy": [6.0, 1.0, 2.0, 4.0]}, "inverted"),
        ({"hypotheses": [wire.NameScore("a\nb", 0.5)]}, "control character"),
        ({"mask": mask_of(np.ones((3, 4)), 5, 3)}, "column 9 and row 6: the image has 8x6"),
        ({"mask": wire.SentMask(0, 0, 4, 4, b"1")}, "1 bytes: expected 2 for 4x4 bits"),
        ({"embedding": b"123"}, "two a number"),
        ({"embedding": np.array([np.inf], "<f2").tobytes()}, "not finite"),
    ],
)
def test_what_is_wrong_is_named(changes, words):
    with pytest.raises(RefusedInput, match=words):
        sent_detections(one(**changes), 8, 6)


def test_an_object_may_lack_an_embedding_but_no_model_its_name():
    message = wire_message(NAMED, embedding_model="clip")
    message.detections[1].embedding = np.ones(3, "<f2").tobytes()
    assert sent_detections(message, 8, 6).embeddings.tolist() == [[0, 0, 0], [1, 1, 1]]
    message.embedding_model = ""
    with pytest.raises(RefusedInput, match="without embedding_model"):
        sent_detections(message, 8, 6)


def test_masks_of_some_objects_or_of_another_image_are_refused():
    message = wire_message(NAMED)
    message.detections[0].mask = mask_of(np.ones((2, 2)))
    with pytest.raises(RefusedInput, match="1 of 2 objects have a mask"):
        sent_detections(message, 8, 6)
    with pytest.raises(RefusedInput, match="is 9x6: the image has 8x6"):
        sent_detections(one(), 8, 6, np.zeros((6, 9), np.uint16))
    for broken in (vision_message([(BOX, {"": 0.5})]), vision_message([(BOX, {"a": 1.5})]),
                   vision_message([([math.nan] * 4, {"a": 0.5})])):  # fmt: skip
        with pytest.raises(RefusedInput) as refused:
            sent_detections(read_detections(broken), 8, 6)
        assert refused.value.reason == "invalid_message"
