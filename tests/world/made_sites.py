"""Made sites as a survey for the solver, and as a map on disk."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import gsmap
from gsmap.formats import gcp_list
from gsmap.geodesy.survey import in_frame
from gsmap.map import Map
from gsmap.types.world import ControlPoint, ImagePoint, Survey
from gsmap_synthetic.surveyed import Site, ground


def survey_of(site: Site, sigma_m: float = 0.01, sigma_px: float = 0.5) -> Survey:
    """As it lies in the catalog, brought into the world frame."""
    checks = set(site.checks())
    row = {name: k for k, name in enumerate(site.names)}
    images = []
    for mark in site.marks:
        cameras = site.cameras[row[mark.scene]]
        for photo, pixel in mark.pixels.items():
            k = cameras.names.index(photo)
            images.append(
                ImagePoint(
                    mark.name, photo, mark.scene, np.array(pixel), sigma_px, cameras.T_frame_camera[k],
                    cameras.intrinsics_px[k],
                )
            )  # fmt: skip
    points = tuple(
        ControlPoint(m.name, site.frame.crs, m.surveyed, (sigma_m, sigma_m), m.name in checks) for m in site.marks
    )
    return in_frame(Survey(site.frame, points, tuple(images)))


def fill(m: Map, site: Site, unit_m: float = 0.5) -> None:
    """Its captures, and edges as a person's own measurements."""
    base = ground(unit_m)
    for k, (name, cameras) in enumerate(zip(site.names, site.cameras, strict=True)):
        import dataclasses

        one = dataclasses.replace(base, sh=base.sh + np.float32(1e-3 * k))  # content of its own
        m.store.scenes.add(one, cameras, name=name)
    for edge in site.edges:
        sigmas = np.diag(edge.information) ** -0.5
        m.add_edge(f"{edge.target}:{edge.source}", edge.S_target_source, sigmas)


def made_map(path: Path, site: Site) -> Map:
    """A new map of a site, solved."""
    m = gsmap.map.create(path)
    fill(m, site)
    m.optimize()
    return m


def write_gcps(path: Path, site: Site) -> Path:
    """Its marks as a file."""
    gcp_list.write(path, site.frame.crs, site.gcp_lines())
    return path
