"""What counts as evidence when two captures are compared."""

from __future__ import annotations

from dataclasses import dataclass

from gsmap.errors import ConfigError


@dataclass(frozen=True)
class Params:
    """How two captures of one place are compared; see `gsmap.compare`.

    Args:
        longest_side_px: size of the views that are rendered.
        max_views: views of each capture, evenly along its path.
        min_alpha: alpha from which on a pixel shows a surface.
        min_weight: a Gaussian that makes up this share of some pixel of its capture's own views is part of a surface.
        nearest_m: what is nearer to a camera than this is not judged by it.
        least_tolerance_m, most_tolerance_m: depths that differ by less are one surface, and by more are two; in
            between the captures' own agreement decides.
        tolerance_spreads: that many robust standard deviations of the depths that agree.
        tolerance_share: and this share of the depth more.
        min_views: views that must agree before anything is concluded, and that must have seen a surface well.
        min_share: of the views that could judge, these must agree.
        min_chroma, min_lightness: colours, in [0, 1], that differ by less after exposure is balanced are one,
        chroma_spreads, lightness_spreads: and so are those within that many robust standard deviations of the pair's
            own differences, which are large where one was lit otherwise.
        cell_m: Gaussians that near vote together,
        neighbours: at most so many of them.
        reach_m: changed Gaussians nearer to each other than this, on one wall or on none, are one change,
        min_roots, root_share: which so many of them, and this share, must prove: looked through more than once, with
        clear_m: nothing of the other capture so near (what is blurred there can be looked through, and stands), or in
        root_colour: another colour by this multiple of what counts. What proves it itself, or differs by
        alone_colour: that multiple whatever its neighbours do, needs no more than to lie
        about_m: as near to such a change.
        link_m: Gaussians of one thing.
        kin_share: of a thing of which this share has changed,
        kin_colour: what differs by this multiple of what counts, and is tied to it, has changed too,
        beside_m: and so has what is so near to it that most of its neighbours on the thing changed.
        by_shell_m: what lies so near to a floor, ceiling or wall may be a frame or a board of it, and goes along with a
            thing only where it lies among what changed of that, or outside of its hull by no more than
        beyond_m: this.
        most_share: of a thing of which this share has changed, what is left is a piece of it, or another thing that
            stood beside. It goes along if its Gaussians reach, in the mean,
        piece_score: this score: 1 for one that has, in the colours that changed on the thing, some as near as
        alike: this, of [0, 1], and
        new_weight: this for the share that is new of the thing that the other capture shows there.
    """

    longest_side_px: int = 240
    max_views: int = 48
    min_alpha: float = 0.9
    min_weight: float = 0.1
    nearest_m: float = 0.2
    least_tolerance_m: float = 0.03
    most_tolerance_m: float = 0.1
    tolerance_spreads: float = 3.5
    tolerance_share: float = 0.01
    min_views: int = 2
    min_share: float = 0.6
    min_chroma: float = 0.06
    min_lightness: float = 0.2
    chroma_spreads: float = 3.0
    lightness_spreads: float = 5.0
    cell_m: float = 0.12
    neighbours: int = 16
    reach_m: float = 0.1
    min_roots: int = 8
    root_share: float = 0.2
    clear_m: float = 0.05
    root_colour: float = 2.0
    alone_colour: float = 4.0
    about_m: float = 0.35
    link_m: float = 0.08
    kin_share: float = 0.2
    kin_colour: float = 0.2
    beside_m: float = 0.15
    by_shell_m: float = 0.1
    beyond_m: float = 0.05
    most_share: float = 0.5
    piece_score: float = 0.7
    alike: float = 0.05
    new_weight: float = 0.5

    def __post_init__(self) -> None:
        for name in ("longest_side_px", "max_views", "min_views", "cell_m", "least_tolerance_m", "reach_m", "link_m"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"{name} must be positive, got {getattr(self, name)}")
        for name in ("min_alpha", "min_share"):
            if not 0 < getattr(self, name) <= 1:
                raise ConfigError(f"{name} must be a share in (0, 1], got {getattr(self, name)}")
