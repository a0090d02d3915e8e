"""The alert rules and the dashboard's file that are shipped, and an edge's status as its metrics take it."""

import json
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parents[2] / "docs/operator/prometheus"
DASHBOARD: Any = json.loads((FOLDER / "dashboard.json").read_text())
RULES = (FOLDER / "servotwin.rules.yml").read_text()
EDGE = {
    "samples": 1, "windows_cut": 1, "version": 0, "fallback": False, "tolerance_m": 0.0, "conflict": False,
    "windows": {"waiting": 0, "dropped": {}}, "disk": {"safe": True, "faults": {}}, "up": {}, "down": {},
    "tick": {"number": 1, "median_us": 1, "p99_us": 1, "p999_us": 1, "max_us": 1}, "written": 1.0,
}  # fmt: skip
