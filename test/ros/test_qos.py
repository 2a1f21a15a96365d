"""The choice of a subscription among what is published, and lost messages."""

import pytest
from sensor_msgs.msg import CompressedImage, Image

from deworldsg_ros.ros.inputs import image_sources
from deworldsg_ros.ros.qos import LossCounter, Offer, choose

RELIABLE, BEST_EFFORT = (
    {
        "raw": Offer("/rgb", "sensor_msgs/msg/Image", reliable),
        "compressed": Offer("/rgb/compressed", "sensor_msgs/msg/CompressedImage", reliable),
        "here": Offer("/rgb", "sensor_msgs/msg/CompressedImage", reliable),
        "text": Offer("/rgb", "std_msgs/msg/String", reliable),
    }
    for reliable in (True, False)
)


@pytest.mark.parametrize(
    ("offers", "topic", "kind", "reliable"),
    [
        ([], "/rgb", Image, True),
        ([RELIABLE["raw"]], "/rgb", Image, True),
        ([BEST_EFFORT["raw"]], "/rgb", Image, False),
        ([RELIABLE["raw"], BEST_EFFORT["raw"]], "/rgb", Image, False),
        ([RELIABLE["compressed"]], "/rgb/compressed", CompressedImage, True),
        ([BEST_EFFORT["here"]], "/rgb", CompressedImage, False),
        ([BEST_EFFORT["compressed"], RELIABLE["raw"]], "/rgb", Image, True),
        ([BEST_EFFORT["text"]], "/rgb", Image, True),
    ],
)
def test_the_first_published_source_is_chosen(offers, topic, kind, reliable):
    choice = choose(image_sources("/rgb", "/compressed", "auto"), offers, "auto")
    assert (choice.source.topic, choice.source.kind, choice.reliable) == (topic, kind, reliable)


def test_a_configured_reliability_and_transport_are_used():
    offers = [RELIABLE["raw"], RELIABLE["compressed"]]
    sources = image_sources("/rgb", "/compressed", "compressed")
    assert choose(sources, offers, "auto").source.kind is CompressedImage
    for offer in (RELIABLE["raw"], BEST_EFFORT["raw"]):
        for word in ("reliable", "best_effort"):
            assert choose(sources, [offer], word).reliable is (word == "reliable")


def test_losses_of_one_publisher_are_counted():
    lost: list[int] = []
    losses = LossCounter(lost.append)

    def arrive(*numbers: int) -> None:
        for number in numbers:
            losses.count({"publication_sequence_number": number})

    arrive(5, 6, 9)
    assert lost == [2]
    arrive(1, 2)  # the publisher was restarted
    losses.publishers = 2
    arrive(7, 3)
    losses.publishers = 1
    arrive(20)
    assert lost == [2]
    losses.restart()
    arrive(30, 32)
    assert lost == [2, 1]
