"""Every fault that tools/planted_faults.py plants still finds the text it changes, and a green one is called green."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]


def _load() -> ModuleType:
    spec = importlib.util.spec_from_file_location("planted_faults", ROOT / "tools" / "planted_faults.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


planted = _load()
FAULTS = planted.read_faults()


@pytest.mark.parametrize("fault", FAULTS, ids=lambda f: f"{f.room}: {f.name}")
def test_applies(fault) -> None:
    assert fault.planted(ROOT) != (ROOT / fault.file).read_text()
    selection = fault.tests.split()[0].split("::")[0]
    assert (ROOT / selection).exists()
    if fault.file.endswith(".py"):
        compile(fault.planted(ROOT), fault.file, "exec")


def test_names_are_unique() -> None:
    names = [(fault.room, fault.name) for fault in FAULTS]
    assert len(set(names)) == len(names)


def test_quick_takes_one_of_each_of_five_rooms() -> None:
    made = [planted.Fault(room, str(i), "f", "a", "b", "t", i == 1) for room in "abcdefg" for i in range(2)]
    quick = planted.chosen(made, [], True)
    assert [fault.room for fault in quick] == list("abcde")
    assert all(fault.quick for fault in quick)


def test_tells_red_from_green(tmp_path: Path) -> None:
    (tmp_path / "code.py").write_text("x = 1\ny = 2\n")
    (tmp_path / "test_code.py").write_text("from code_of import x\n\n\ndef test_x():\n    assert x == 1\n")
    (tmp_path / "code_of.py").write_text("from pathlib import Path\n\nexec(Path('code.py').read_text())\n")

    def plant(old: str, new: str, tests: str = "test_code.py") -> str:
        return planted.verdict(planted.Fault("room", "fault", "code.py", old, new, tests), tmp_path)

    assert plant("x = 1", "x = 3") == "red"
    assert plant("y = 2", "y = 3").startswith("GREEN")
    assert plant("x = 1", "x = 3", "test_code.py -k nothing").startswith("no tests ran")
    assert (tmp_path / "code.py").read_text() == "x = 1\ny = 2\n"
    with pytest.raises(ValueError, match="found it 0 times"):
        plant("z", "a")
    with pytest.raises(ValueError, match="found it 2 times"):
        plant(" = ", " == ")
