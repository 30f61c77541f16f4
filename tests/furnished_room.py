"""Points on the surfaces of a furnished room."""

import numpy as np


def furnished_room(seed: int, *, noise_m: float, per_m2: int) -> np.ndarray:
    """Points on the walls, the floor and the furniture of a room of 6 x 5 x 2.5 m about the origin."""
    rng, parts = np.random.default_rng(seed), []
    boxes = [((0, 0, 0), (6, 5, 2.5)), ((1, 1, 0), (2, 2.5, 0.8)), ((4, 3, 0), (5.2, 3.6, 1.9))]
    for low, high in np.array(boxes, np.float64):
        for axis in range(3):
            for side in (low, high):
                area = np.prod(np.delete(high - low, axis))
                points = rng.uniform(low, high, (int(per_m2 * area), 3))
                points[:, axis] = side[axis] + rng.normal(0, noise_m, len(points))
                parts.append(points)
    return np.concatenate(parts) - [3, 2.5, 1.25]
