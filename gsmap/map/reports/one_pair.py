"""Find the scenes that one pair places: no cycle confirms it, nothing contradicts it, and its verdict is accepted."""

from __future__ import annotations

from gsmap.store import Store
from gsmap.types import EdgeOutcome

ONE_PAIR = "one pair"
"""What tables call such an edge, and a scene that it places; JSON has ``tentative``."""


def is_one_pair(outcome: EdgeOutcome) -> bool:
    """Return whether an edge places a scene alone without doubt: its surfaces agree and no edge contradicts it."""
    return outcome.use == "tentative" and not outcome.undecided and outcome.reason_code == "unconfirmed"


def scenes_by_one_pair(store: Store) -> set[str]:
    """Return the ids of the tentative scenes that only such edges connect to the placed part of their component.

    In a component without a placed scene, these are all scenes, if such edges connect them.
    """
    poses = store.revisions.poses()
    tentative = {scene for scene, pose in poses.items() if pose.status == "tentative"}
    if not tentative:
        return set()
    block = {scene: scene for scene in poses}

    def root(scene: str) -> str:
        while block[scene] != scene:
            block[scene] = scene = block[block[scene]]
        return scene

    for (target, source), outcome in store.revisions.outcomes().items():
        if target in block and source in block and (outcome.use == "used" or is_one_pair(outcome)):
            block[root(target)] = root(source)
    blocks: dict[int, set[str]] = {}
    firm = set()
    for scene, pose in poses.items():
        blocks.setdefault(pose.component, set()).add(root(scene))
        if pose.status == "placed":
            firm.add(root(scene))
    return {scene for scene in tentative if root(scene) in firm or blocks[poses[scene].component] == {root(scene)}}
