"""SAM, SAM 2 and SAM 3: box prompts, batches of boxes, and checkpoints that are refused."""

from unittest.mock import Mock

import numpy as np
import pytest
from support import torch_models as models
from support.perception import on_image
from support.torch_models import image, settings, torch

from deworldsg_ros.perception.backends.sam import Sam2Segmenter, Sam3Segmenter, SamSegmenter
from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.errors import ConfigurationError

pytestmark = pytest.mark.models

BACKENDS = {
    "sam2": Sam2Segmenter,
    "sam2_video": Sam2Segmenter,
    "sam3": Sam3Segmenter,
    "sam3_video": Sam3Segmenter,
    "sam": SamSegmenter,
}
HEIGHT, WIDTH = 60, 80
RGB = image(HEIGHT, WIDTH)
INTRINSICS = Intrinsics(70.0, 70.0, 39.5, 29.5, WIDTH, HEIGHT)
DEPTH = np.ones((HEIGHT, WIDTH), np.float32)
BOXES = np.array(
    [[5, 5, 30, 40], [20, 10, 70, 50], [0, 0, 79, 59], [40, 30, 60, 45], [2, 40, 20, 58]], float
)


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    root = tmp_path_factory.mktemp("sam")
    return {
        "sam2": models.save_sam2(root / "sam2"),
        "sam2_video": models.save_sam2(root / "sam2_video", video=True),
        "sam3": models.save_sam3(root / "sam3"),
        "sam3_video": models.save_sam3(root / "sam3_video", video=True),
        "sam": models.save_sam(root / "sam"),
    }


def segmenter(folders, name, **changes):
    return BACKENDS[name](settings(segmenter_path=str(folders[name])), **changes)


def masks(backend, boxes=BOXES):
    found = backend.segment(RGB, DEPTH, INTRINSICS, boxes)
    return np.array([on_image(patch, (HEIGHT, WIDTH)) for patch in found])


@pytest.mark.parametrize("name", BACKENDS)
def test_one_mask_per_box_of_an_image_that_is_encoded_once(folders, name, monkeypatch):
    backend = segmenter(folders, name, box_batch=16)
    found = masks(backend)
    assert found.shape == (len(BOXES), HEIGHT, WIDTH)
    # Random weights, but masks that say something, and depend on the box.
    assert 0.02 < found.mean() < 0.98
    assert len({mask.tobytes() for mask in found}) > 1
    # The batch of boxes does not change the masks.
    for box_batch in (1, 2):
        backend = segmenter(folders, name, box_batch=box_batch)
        encode = Mock(side_effect=backend.model.get_image_embeddings)
        monkeypatch.setattr(backend.model, "get_image_embeddings", encode)
        assert (masks(backend) != found).mean() < 1e-3
        assert len(masks(backend, np.zeros((0, 4)))) == 0
        assert encode.call_count == 1


def test_sam2_masks_equal_those_of_the_network_on_the_stretched_image(folders):
    model = models.transformers.Sam2Model.from_pretrained(folders["sam2"]).eval()
    pixels = torch.from_numpy(RGB.astype(np.float32)).permute(2, 0, 1)[None]
    pixels = torch.nn.functional.interpolate(
        pixels, size=(128, 128), mode="bilinear", antialias=True, align_corners=False
    )
    mean = torch.tensor([0.485, 0.456, 0.406])[:, None, None]
    std = torch.tensor([0.229, 0.224, 0.225])[:, None, None]
    boxes = torch.tensor(BOXES) * torch.tensor([128 / WIDTH, 128 / HEIGHT] * 2)
    with torch.no_grad():
        output = model(
            pixel_values=(pixels / 255 - mean) / std,
            input_boxes=boxes[None].float(),
            multimask_output=False,
        )
    logits = torch.nn.functional.interpolate(
        output.pred_masks[0], size=(HEIGHT, WIDTH), mode="bilinear", align_corners=False
    )
    expected = (logits[:, 0] > 0).numpy()
    assert (masks(segmenter(folders, "sam2")) != expected).mean() < 1e-3


def test_sam3_takes_its_tracker_from_the_published_layout(folders):
    """The published checkpoint has detector and tracker, with one vision encoder for both."""
    whole = models.transformers.Sam3VideoModel.from_pretrained(folders["sam3_video"]).state_dict()
    found = segmenter(folders, "sam3_video").model.state_dict()
    prefixes = {
        "vision_encoder.backbone.": "detector_model.vision_encoder.backbone.",
        "vision_encoder.neck.": "tracker_neck.",
        "": "tracker_model.",
    }
    for name, value in found.items():
        prefix = next(prefix for prefix in prefixes if name.startswith(prefix))
        assert torch.equal(value, whole[prefixes[prefix] + name.removeprefix(prefix)]), name


def test_inputs_are_scaled_as_each_network_expects(folders):
    sam3, sam = segmenter(folders, "sam3"), segmenter(folders, "sam")
    for value, expected in ((0, -1), (255, 1)):
        grey = np.full((8, 8, 3), value, np.uint8)
        assert float(sam3._input(grey).mean()) == pytest.approx(expected)
    # SAM keeps the aspect ratio, and adds black below.
    assert sam._scale(60, 80) == (1.6, 1.6)
    pixels = sam._input(RGB)
    assert pixels.shape == (1, 3, 128, 128)
    assert pixels[0, :, 96:].abs().max() == 0 and pixels[0, :, :96].abs().min() >= 0
    assert pixels[0, :, 95].abs().max() > 0


def test_a_checkpoint_that_does_not_fit_is_refused(folders, tmp_path, monkeypatch):
    def refused(match, backend, folder, **changes):
        with pytest.raises(ConfigurationError, match=match):
            backend(settings(segmenter_path=str(folder), **changes))

    def full(*arguments):
        raise RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 1")

    refused("of sam: expected sam2 or sam2_video", Sam2Segmenter, folders["sam"])
    refused("of rt_detr: expected sam", SamSegmenter, models.save_rtdetr(tmp_path))
    refused("of sam2: expected sam3_tracker", Sam3Segmenter, folders["sam2"])
    refused("segmenter_path is empty", Sam2Segmenter, "")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    refused("perception.device is 'cuda'", SamSegmenter, folders["sam"], device="cuda")
    monkeypatch.setattr(Sam2Segmenter, "_masks", full)
    refused("out of memory .* smaller perception.segmenter_", Sam2Segmenter, folders["sam2"])
