"""Backup, restore and clone: states of a map as files named by their content, in a folder or an object store."""

from gsmap.store.backup.repository import Backup, Snapshot
from gsmap.store.backup.restoring import Cloned, Restored, clone, restore
from gsmap.store.backup.saving import Saved, save

__all__ = ["Backup", "Cloned", "Restored", "Saved", "Snapshot", "clone", "restore", "save"]
