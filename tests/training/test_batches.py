"""Augmentations of training images that narrow the gap to photographs: blur, texture, no colour."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.training import RECIPE, bank

from ssad.core.errors import ConfigError
from ssad.training.batches import add_clutter, blur_images, make_batch, natural_texture
from ssad.training.recipe import find_recipe

CPU = torch.device("cpu")


def test_blur_spreads_a_point_and_keeps_its_light() -> None:
    images = torch.zeros(64, 3, 41, 41)
    images[:, :, 20, 20] = 1.0
    blurred = blur_images(images, 2.0, torch.Generator().manual_seed(1))
    torch.testing.assert_close(blurred.sum((2, 3)), torch.ones(64, 3))
    is_sharp = blurred[:, 0, 20, 20] > 0.999
    assert 16 < int(is_sharp.sum()) < 48
    offsets = torch.arange(41.0) - 20
    variance = (blurred[:, 0].sum(1) * offsets**2).sum(-1)
    assert float(variance.max()) == pytest.approx(4.0, rel=0.2)
    torch.testing.assert_close(blurred, blurred.transpose(2, 3))


def test_blur_leaves_even_images() -> None:
    images = torch.rand(8, 3, 1, 1, generator=torch.Generator().manual_seed(0)).expand(8, 3, 16, 24)
    torch.testing.assert_close(blur_images(images, 3.0, torch.Generator().manual_seed(2)), images)


def test_amplitude_of_texture_falls_with_the_inverse_of_frequency() -> None:
    texture = natural_texture((16, 256, 256), torch.Generator().manual_seed(0), CPU)
    torch.testing.assert_close(texture.std((-2, -1)), torch.ones(16), rtol=1e-4, atol=1e-4)
    assert float(texture.mean((-2, -1)).abs().max()) < 1e-4
    amplitude = torch.fft.rfft2(texture).abs().square().mean(0).sqrt()[0, 1:100]
    slope = np.polyfit(np.log(np.arange(1, 100)), np.log(amplitude.numpy()), 1)[0]
    assert slope == pytest.approx(-1.0, abs=0.1)


def test_clutter_covers_parts_and_has_a_limited_contrast() -> None:
    images = torch.full((32, 3, 64, 64), 0.5)
    change = (add_clutter(images, 0.1, torch.Generator().manual_seed(0)) - images).abs()
    assert 0.0 < float(change.mean()) < 0.1
    local_change = torch.nn.functional.avg_pool2d(change.mean(1, keepdim=True), 16).flatten(1)
    assert float((local_change.amax(1) / local_change.amin(1).clamp_min(1e-9)).median()) > 3.0
    torch.testing.assert_close(add_clutter(images, 0.0, torch.Generator().manual_seed(0)), images)


def test_an_image_loses_its_colour_with_the_stated_probability() -> None:
    images = bank()
    indices = list(range(4)) * 16
    recipe = replace(RECIPE, jitter=0.0, noise=0.0, flip=0.0, zoom=(1.0, 1.0), grey=0.5)
    batch, _ = make_batch(images, indices, recipe, key=(1, 2), device=CPU)
    is_grey = (batch.amax(1) - batch.amin(1)).amax((1, 2)) < 1e-6
    coloured, _ = make_batch(images, indices, replace(recipe, grey=0.0), key=(1, 2), device=CPU)
    assert not ((coloured.amax(1) - coloured.amin(1)).amax((1, 2)) < 1e-6).any()
    assert 16 < int(is_grey.sum()) < 48
    torch.testing.assert_close(batch[~is_grey], coloured[~is_grey])
    torch.testing.assert_close(batch[is_grey], coloured[is_grey].mean(1, keepdim=True).expand(-1, 3, -1, -1))


def test_the_key_decides_every_augmentation() -> None:
    recipe = replace(RECIPE, blur=2.0, grey=0.3, clutter=0.2)
    first, again, other = (
        make_batch(bank(), [0, 1, 2], recipe, key=key, device=CPU)[0] for key in ((1, 2), (1, 2), (1, 3))
    )
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert float(first.min()) >= 0.0
    assert float(first.max()) <= 1.0


@pytest.mark.parametrize("changes", [{"blur": -1.0}, {"grey": 1.5}, {"clutter": -0.1}])
def test_a_strength_out_of_range_is_one_line(changes: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=next(iter(changes))):
        find_recipe("yolov5n", **changes)
