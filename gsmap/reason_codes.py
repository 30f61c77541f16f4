"""Stable codes by which programs distinguish reasons.

Messages are worded for people and change from version to version; the meaning of a code does not. A result that is a
refusal, such as a rejected edge or a photo without a pose, has a reason in words and a ``reason_code``, a key of
`REASONS`. Codes of errors (`GsmapError.code`) are listed in docs/reference/json.md.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Final

REASONS: Final[Mapping[str, tuple[str, str]]] = {
    # Pairs of scenes that are not accepted.
    "collinear_correspondences": ("The correspondences lie along a line.", r"correspondences lie along a line"),
    "colours_disagree": ("Colours disagree where surfaces coincide.", r"colours disagree"),
    "correspondences_lost": (
        "Refinement moves the pose away from its correspondences.",
        r"surfaces pull the pose away|refinement moved the pose away",
    ),
    "free_space_violation": (
        "A scene has surface where the other scene saw free space.",
        r"free-space violation|\S+% of the (surface|points) seen contradict",
    ),
    "inconsistent_correspondences": (
        "The correspondences fit no single pose.",
        r"correspondences do not fit one pose|no single pose fits",
    ),
    "mirrored_correspondences": ("The correspondences fit a mirrored pose only.", r"correspondences are mirrored"),
    "no_pose_proposed": (
        "No proposer found a pose.",
        r"chance explains every proposed pose|no pose (found|proposed|under which|that more nodes support)|"
        r"no match that chance|too few nodes agree",
    ),
    "not_significant": ("The correspondences may have arisen by chance.", r"not significant"),
    "package_missing": (
        "A package that the comparison needs is not installed.",
        r"(comparing shapes|registration by shape) needs an|shapes are compared by a package",
    ),
    "rejected_by_person": ("A person rejected the edge.", r"rejected by a person"),
    "too_little_overlap": ("Too little surface coincides.", r"too little surface coincides"),
    "unit_unknown": (
        "The metric scale of a scene is unknown.",
        r"(comparing shapes|registration by shape) needs scenes|shapes are compared in metres",
    ),
    # Of pairs, photos and scans.
    "ambiguous": ("Another pose or place fits about as well.", r"ambiguous: |it fits two places"),
    "look_alike": ("Two places that look alike, or one that was refurnished.", r"two places that look alike \("),
    "not_probable": ("The pose is not probable enough given all evidence.", r"not probable enough"),
    "pose_uncertain": (
        "The pose is too uncertain.",
        r"(the overlap|the photo|what it shows) (determines|fixes) (the|its) pose only",
    ),
    # Photos and scans that are refused.
    "no_match": (
        "Nothing in the map resembles the photo or scan.",
        r"nothing in the map looks like it|no scene of the map has any",
    ),
    "no_views": ("The map has no views to compare a photo with.", r"the map (shows nothing|has no views) to compare"),
    "no_scene_matches": ("No compared scene shows the photo or scan.", r"\d+ scenes were compared and none"),
    "not_confirmed": (
        "Too few patches of the map are found again in the photo.",
        r"what the map shows there is not|patches of the map at this pose are not",
    ),
    "too_far": ("The pose lies outside the specified area.", r"it was taken .* from there"),
    "too_few_features": ("The photo has too few features.", r"(it|the photo) shows too little"),
    # Edges that are accepted, and that optimize does not use or does not rely on.
    "aliased_places": (
        "Places that look alike cannot be told apart.",
        r"(places that look|a place that looks) alike\?",
    ),
    "confirmed_by_person": ("A person confirmed the edge.", r"confirmed by a person"),
    "contradicting_groups": ("Two groups of edges contradict each other.", r"edges that agree among themselves"),
    "contradicts_component": (
        "The edge contradicts other evidence of two components.",
        r"contradicts (what else|other edges between)",
    ),
    "contradicts_edge": (
        "The edge contradicts an edge with similar evidence.",
        r"contradicts an edge whose evidence",
    ),
    "contradicts_edges": ("The edge contradicts the other edges.", r"contradicts the other edges"),
    "outvoted": ("Too few edges agree against those that contradict them.", r"\d+ edges agree and \d+ others"),
    "surfaces_differ": (
        "Both scenes may show two places that look alike, or one that changed.",
        r"the captures show two places that look alike|edges of this map that are as likely|"
        r"\S+% of what both saw is not the same",
    ),
    "too_few_edges": ("Too few agreeing edges join two large components.", r"would join two (components|islands)"),
    "unconfirmed": (
        "No cycle of edges confirms the edge.",
        r"in no agreeing cycle|repeats another edge|ties two islands that nothing else joins|the only tie to the rest",
    ),
    # World observations.
    "contradicts_observations": (
        "The observation contradicts the other observations.",
        r"it contradicts the other observations|the other (scale )?bars contradict it",
    ),
    "no_ray": ("No two photos show the control point.", r"no two photos show it"),
    # Captures that are not thinned.
    "fidelity_too_low": ("Thinning would change the capture's pictures too much.", r"compact, its pictures would"),
    "pose_unconfirmed": ("The capture's pose is not confirmed.", r"its pose is not confirmed"),
    "seen_too_little": ("Newer captures observed too little of the capture.", r"newer captures that stay whole saw"),
    # Anything else.
    "other": ("Another reason.", r""),
}
"""The reason of each code in one sentence, and a pattern that matches the beginning of its texts, also of old texts."""


_PATTERN = re.compile("|".join(f"(?P<{code}>{pattern})" for code, (_, pattern) in REASONS.items()))


def reason(code: str, text: str) -> str:
    """Return the text of a reason after checking that the text has this code, as it must when it is read back."""
    assert reason_code(text) == code, f"give {code!r} in REASONS a pattern for {text!r}"
    return text


def reason_code(text: str) -> str:
    """Return the code of a reason's text; empty for an empty text."""
    if not text:
        return ""
    found = _PATTERN.match(text)
    assert found is not None  # "other" matches any text
    assert found.lastgroup is not None
    return found.lastgroup
