"""Filters of images beside those of scipy."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from gsmap.geometry.filters import blur


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize("reflect", [True, False])
def test_images_of_every_width_are_blurred(reflect):
    rng = np.random.default_rng(0)
    for width in range(1, 150):
        image = rng.normal(size=(3, width)).astype(np.float32)
        expected = gaussian_filter(image.astype(float), 1.2, mode="reflect" if reflect else "nearest")
        np.testing.assert_allclose(blur(image, 1.2, reflect=reflect), expected, atol=1e-5)
