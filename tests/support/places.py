"""Where the repository and its parts are, so that a test does not count the folders above it."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "results"
SUPPORT = ROOT / "tests" / "support"
"""What a test's own process needs in PYTHONPATH to import the helpers."""
GUARANTEES = ROOT / "tests" / "guarantees"
