"""The settings of gsmap are few, and one whole sentence explains each."""

from __future__ import annotations

import re

from gsmap.map.settings import Settings
from gsmap.settings import leaves

MAX_SETTINGS = 160
SENTENCE = re.compile(r"[A-Z][^…]*[^.,…]\.")


def test_settings_are_few():
    assert len(list(leaves(Settings()))) <= MAX_SETTINGS


def test_each_meaning_is_one_whole_sentence():
    assert not [leaf.name for leaf in leaves(Settings()) if not SENTENCE.fullmatch(leaf.meaning)]
