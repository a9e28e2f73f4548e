"""``benchmarks/shift.py``: a known shift is found, in another light too."""

import numpy as np
import pytest
from pages import load
from PIL import Image

shift = load("benchmarks/shift.py")


def waves(right=0.0, down=0.0):
    """A picture in [0, 1], ``[96, 128]``, of waves of many directions, moved by a distance in pixels."""
    chance = np.random.default_rng(0)
    y, x = np.mgrid[:96, :128].astype(float)
    turns, steps, phases = chance.uniform(0, 2 * np.pi, 60), chance.uniform(0.1, 0.7, 60), chance.uniform(0, 7, 60)
    along = np.multiply.outer(np.cos(turns), x - right) + np.multiply.outer(np.sin(turns), y - down)
    return 0.5 + np.sin(steps[:, None, None] * along + phases[:, None, None]).mean(0)


@pytest.mark.parametrize("moved", [(0.0, 0.0), (0.4, -0.7), (-2.0, 0.3)])
def test_a_known_shift_is_found_in_another_light(moved):
    found, alike = shift.shift_of(waves() ** 2 / 80, waves(*moved))
    assert found == pytest.approx(moved, abs=0.03)
    assert alike > 0.97


def test_pairs_of_two_folders_are_told(tmp_path, capsys, monkeypatch):
    for folder, picture in (("low", waves() / 4), ("high", waves(1.0, 0.0))):
        (tmp_path / folder).mkdir()
        for name in ("a.png", "b.png") if folder == "low" else ("a.png",):
            Image.fromarray((picture * 255).round().astype(np.uint8)).save(tmp_path / folder / name)
    monkeypatch.setattr("sys.argv", ["shift.py", str(tmp_path / "low"), str(tmp_path / "high")])
    shift.main()
    first, last = capsys.readouterr().out.splitlines()
    assert first.startswith("a.png: +1.0")
    assert last == "1 pairs: median 1.00 pixels, mean 1.00, largest 1.00, above 0.2 in 1"
