"""The lens of the camera path: its thresholds scale with the image, wherever the principal point is."""

import numpy as np
from relief import HEIGHT, MATRIX, WIDTH, path, view

from endoprior.prepare.camera_path.own import own_path
from endoprior.prepare.camera_path.tracks import Lens, PoseInput


def test_the_principal_point_may_lie_at_the_edge_of_the_image():
    """As after `--crop`: thresholds follow from the width of the image."""
    true = path(24)
    part = np.s_[:, 80:]
    cropped = [PoseInput(seen.rgb_u8[part], seen.tissue_mask[part], seen.depth[part]) for seen in map(view, true)]
    matrix = MATRIX - [[0, 0, 80], [0, 0, 0], [0, 0, 0]]
    right = Lens.centered_at_half(matrix, WIDTH - 80, False, 4.0)
    assert right.px == (WIDTH - 80) / 640 and right.with_focal(2.0).px == right.px
    found, _ = own_path(cropped.__getitem__, 24, right, (WIDTH - 80, HEIGHT))
    off = found.camera_to_world[:, :3, 3] - (np.linalg.inv(true[0]) @ true)[:, :3, 3]
    assert found.explained.all() and np.linalg.norm(off, axis=1).max() < 2.0  # mm, by half of the view
