"""Store what every method gives for its small input: tests/contracts/golden.json, which tests/contracts holds it to.

Run it after raising the VERSION of a method whose output has changed on purpose::

    python -m tools.make.golden
"""

from __future__ import annotations

import sys
from pathlib import Path

from tools.harness import argument_parser, say


def main() -> int:
    argument_parser(__doc__).parse_args()
    sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "contracts"))
    import sketches

    changed = sketches.write()
    for name in changed:
        print(name)
    say(f"{len(changed)} of {len(sketches.cases())} changed")
    return 0


if __name__ == "__main__":
    sys.exit(main())
