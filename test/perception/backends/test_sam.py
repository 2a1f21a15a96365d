"""SAM 2 and SAM: box prompts, batches of boxes, and checkpoints that are refused."""

from __future__ import annotations

import numpy as np
import pytest
from support.perception import on_image
from support.torch_models import (
    image,
    save_rtdetr,
    save_sam,
    save_sam2,
    save_sam3,
    settings,
    torch,
    transformers,
)

from deworldsg_ros.perception.backends.sam import (
    Sam2Segmenter,
    Sam3Segmenter,
    SamSegmenter,
    as_patch,
)
from deworldsg_ros.perception.stage import instance_image
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
INTRINSICS = Intrinsics(70.0, 70.0, 39.5, 29.5, WIDTH, HEIGHT)
DEPTH = np.ones((HEIGHT, WIDTH), np.float32)
BOXES = np.array(
    [[5, 5, 30, 40], [20, 10, 70, 50], [0, 0, 79, 59], [40, 30, 60, 45], [2, 40, 20, 58]], float
)


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    root = tmp_path_factory.mktemp("sam")
    return {
        "sam2": save_sam2(root / "sam2"),
        "sam2_video": save_sam2(root / "sam2_video", video=True),
        "sam3": save_sam3(root / "sam3"),
        "sam3_video": save_sam3(root / "sam3_video", video=True),
        "sam": save_sam(root / "sam"),
    }


def segmenter(folders, name, **changes):
    return BACKENDS[name](settings(segmenter_path=str(folders[name])), **changes)


def masks(backend, rgb, boxes=BOXES):
    found = backend.segment(rgb, DEPTH, INTRINSICS, boxes)
    return np.array([on_image(patch, rgb.shape[:2]) for patch in found])


@pytest.mark.parametrize("name", BACKENDS)
def test_one_mask_per_box_at_image_size(folders, name):
    found = masks(segmenter(folders, name), image(HEIGHT, WIDTH))
    assert found.shape == (len(BOXES), HEIGHT, WIDTH)
    # Random weights, but masks that say something, and depend on the box.
    assert 0.02 < found.mean() < 0.98
    assert len({mask.tobytes() for mask in found}) > 1


@pytest.mark.parametrize("name", BACKENDS)
def test_the_box_batch_does_not_change_the_masks(folders, name):
    rgb = image(HEIGHT, WIDTH)
    whole = masks(segmenter(folders, name, box_batch=16), rgb)
    for box_batch in (1, 2):
        parts = masks(segmenter(folders, name, box_batch=box_batch), rgb)
        assert (parts != whole).mean() < 1e-3


@pytest.mark.parametrize("name", BACKENDS)
def test_an_image_is_encoded_once(folders, name, monkeypatch):
    backend = segmenter(folders, name, box_batch=2)
    encode, calls = backend.model.get_image_embeddings, []
    monkeypatch.setattr(
        backend.model, "get_image_embeddings", lambda pixels: calls.append(1) or encode(pixels)
    )
    masks(backend, image(HEIGHT, WIDTH))
    assert len(calls) == 1
    assert backend.segment(image(HEIGHT, WIDTH), DEPTH, INTRINSICS, np.zeros((0, 4))) == []
    assert len(calls) == 1


def test_sam2_masks_equal_those_of_the_network_on_the_stretched_image(folders):
    rgb = image(HEIGHT, WIDTH)
    model = transformers.Sam2Model.from_pretrained(folders["sam2"]).eval()
    pixels = torch.from_numpy(rgb.astype(np.float32)).permute(2, 0, 1)[None]
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
    assert (masks(segmenter(folders, "sam2"), rgb) != expected).mean() < 1e-3


def test_sam3_takes_its_tracker_from_the_published_layout(folders):
    """The published checkpoint has detector and tracker, with one vision encoder for both."""
    whole = transformers.Sam3VideoModel.from_pretrained(folders["sam3_video"]).state_dict()
    found = segmenter(folders, "sam3_video").model.state_dict()
    prefixes = {
        "vision_encoder.backbone.": "detector_model.vision_encoder.backbone.",
        "vision_encoder.neck.": "tracker_neck.",
        "": "tracker_model.",
    }
    for name, value in found.items():
        prefix = next(prefix for prefix in prefixes if name.startswith(prefix))
        assert torch.equal(value, whole[prefixes[prefix] + name.removeprefix(prefix)]), name


def test_sam3_normalises_to_plus_minus_one(folders):
    backend = segmenter(folders, "sam3")
    black, white = (np.full((8, 8, 3), value, np.uint8) for value in (0, 255))
    assert float(backend._input(black).mean()) == pytest.approx(-1)
    assert float(backend._input(white).mean()) == pytest.approx(1)


def test_sam_keeps_the_aspect_ratio_of_the_image(folders):
    """A square image and the same image with black below: the upper masks are the same."""
    backend = segmenter(folders, "sam")
    assert backend._scale(60, 80) == (1.6, 1.6)
    pixels = backend._input(image(60, 80))
    assert pixels.shape == (1, 3, 128, 128)
    assert pixels[0, :, 96:].abs().max() == 0 and pixels[0, :, :96].abs().min() >= 0
    assert pixels[0, :, 95].abs().max() > 0


@pytest.mark.parametrize("name", BACKENDS)
def test_half_precision_runs_through(folders, name):
    rgb = image(HEIGHT, WIDTH)
    backend = segmenter(folders, name)
    exact = masks(backend, rgb)
    backend.model, backend.dtype = backend.model.half(), torch.float16
    assert (masks(backend, rgb) != exact).mean() < 0.1


def test_pixels_in_masks_of_two_classes_belong_to_no_object(folders):
    found = segmenter(folders, "sam2").segment(image(HEIGHT, WIDTH), DEPTH, INTRINSICS, BOXES[:2])
    one, two = (on_image(patch, (HEIGHT, WIDTH)) for patch in found)
    labels = instance_image(found, np.array([0, 1]), np.array([0.9, 0.8]), (HEIGHT, WIDTH))
    assert (one & two).any()
    assert not labels[one & two].any()
    assert (labels[one & ~two] == 1).all() and (labels[two & ~one] == 2).all()


@pytest.mark.parametrize("pixels", [[], [(3, 4)], [(0, 0), (5, 6)], [(2, 1), (4, 1)]])
def test_a_patch_contains_all_pixels_of_the_mask(pixels):
    mask = np.zeros((6, 7), bool)
    for row, column in pixels:
        mask[row, column] = True
    patch = as_patch(mask)
    assert np.array_equal(on_image(patch, mask.shape), mask)
    assert patch.pixels.size <= mask.size


def test_a_checkpoint_of_another_architecture_is_refused(folders, tmp_path):
    with pytest.raises(ConfigurationError, match="of sam: expected sam2 or sam2_video"):
        Sam2Segmenter(settings(segmenter_path=str(folders["sam"])))
    with pytest.raises(ConfigurationError, match="of rt_detr: expected sam"):
        SamSegmenter(settings(segmenter_path=str(save_rtdetr(tmp_path))))
    with pytest.raises(ConfigurationError, match="of sam2: expected sam3_tracker"):
        Sam3Segmenter(settings(segmenter_path=str(folders["sam2"])))


def test_a_missing_path_and_missing_cuda_are_refused(folders, monkeypatch):
    with pytest.raises(ConfigurationError, match="segmenter_path is empty"):
        Sam2Segmenter(settings())
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ConfigurationError, match="perception.device is 'cuda'"):
        SamSegmenter(settings(segmenter_path=str(folders["sam"]), device="cuda"))


def test_out_of_memory_at_start_up_names_a_remedy(folders, monkeypatch):
    def full(*arguments):
        raise RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 1")

    monkeypatch.setattr(Sam2Segmenter, "_masks", full)
    with pytest.raises(ConfigurationError, match="out of memory .* smaller perception.segmenter_"):
        segmenter(folders, "sam2")
