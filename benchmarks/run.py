"""Runs all benchmarks one after the other, and writes one report.

python benchmarks/run.py --out runs/bench.md
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from importlib import import_module
from pathlib import Path

PARTS = {
    "env_speed": "Environments",
    "writer_speed": "Writing with hindsight",
    "replay_speed": "Replay of several runs in one buffer",
    "update_speed": "Gradient steps and the whole loop",
    "parallel.processes": "Collecting in processes",
    "parallel.nodes": "Collecting on the nodes of a cluster",
    "many_runs": "Many runs as one program",
    "ibs_update": "How often q is brought up to date",
    "memory": "Memory",
    "startup": "Start-up",
    "checkpoint_cost": "Checkpoints",
    "time_to_learn": "Time to learn",
    "task_check": "The tasks can be solved",
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "parts", nargs="*", metavar="PART", help=f"some of {', '.join(PARTS)}; all if none is named"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("runs/bench.md"), help="where the report goes (%(default)s)"
    )
    options = parser.parse_args()
    unknown = set(options.parts) - set(PARTS)
    if unknown:
        parser.error(f"there is no {', '.join(sorted(unknown))}; the parts are {', '.join(PARTS)}")
    options.out.parent.mkdir(parents=True, exist_ok=True)
    sections, failed = ["# Benchmarks"], False
    for name in options.parts or PARTS:
        print(f"\n{PARTS[name]}\n")
        with tempfile.TemporaryDirectory() as folder:
            table = Path(folder) / "table.md"
            failed |= bool(import_module(name).main(["--out", str(table)]))
            command = f"python benchmarks/run.py {name}" if "." in name else f"python benchmarks/{name}.py"
            sections.append(f"## {PARTS[name]}\n\n`{command}`\n\n{table.read_text().strip()}")
        options.out.write_text("\n\n".join(sections) + "\n")  # after each part, in case a later part fails
    print(f"\nreport: {options.out}")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
