"""Twenty seconds of what tools/soak.py does for ten minutes."""

import subprocess
import sys
from pathlib import Path

import pytest

SOAK = Path(__file__).resolve().parents[2] / "tools" / "soak.py"


@pytest.mark.slow
@pytest.mark.parametrize("options", [[], ["--postgres", "temporary", "--only-postgres"]], ids=["sqlite", "postgres"])
def test_writers_readers_and_a_backup_share_a_map(options):
    if options:
        pytest.importorskip("psycopg")
    command = [sys.executable, SOAK, "--minutes", "0.33", "--writers", "4", "--readers", "3", "--backup", *options]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 lost or wrong, 0 locked, 0 other errors, 0 died" in done.stdout
