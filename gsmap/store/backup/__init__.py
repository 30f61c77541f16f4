"""Backup, restore and clone maps: snapshots of content-addressed files in a folder or an object store."""

from gsmap.store.backup.repository import Backup, Snapshot
from gsmap.store.backup.restoring import clone, restore
from gsmap.store.backup.saving import save

__all__ = ["Backup", "Snapshot", "clone", "restore", "save"]
