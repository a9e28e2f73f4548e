"""Fixtures that all tests share."""

import os
from pathlib import Path

import pytest
from hypothesis import settings

# Shared machines stall now and then: a deadline an example would fail tests for nothing.
settings.register_profile("ctm", deadline=None)
settings.load_profile("ctm")


@pytest.fixture(scope="session")
def ctm_data() -> Path:
    """Folder of the real data sets: ``CTM_DATA``, by default ``../shared/data`` beside the repository."""
    default = Path(__file__).parents[2] / "shared" / "data"
    folder = Path(os.environ.get("CTM_DATA") or default)
    if not folder.is_dir():
        why = f"real data not found at {folder}; set CTM_DATA to their folder"
        # On CI a missing folder is a broken set-up: skipping would turn it green.
        pytest.fail(why) if os.environ.get("CI") else pytest.skip(why)
    return folder
