"""Pictures of runs, as they have written them."""

import numpy as np

from ctm_plugin.report.labels import find_runs
from ctm_plugin.report.pairs import picture, pictures, where_they_differ


def test_what_a_run_has_written_by_kind(made):
    run = find_runs([made("ctm=off", views=True)]).runs[0]
    assert {kind: path.parent.name for kind, path in pictures(run).items()} == {
        kind: kind for kind in ("lit", "dark", "latent", "depth", "photo")
    }
    assert not np.array_equal(picture(run, "lit"), picture(run, "dark"))


def test_a_tint_of_all_is_no_difference():
    """The window is where something differs, not where black became nearly black."""
    first = np.zeros((32, 40, 3), np.uint8)
    second = first + np.uint8(9)
    second[20:24, 8:12] = 60
    rows, columns = where_they_differ(first, second)
    assert rows.start <= 20 < 24 <= rows.stop
    assert columns.start <= 8 < 12 <= columns.stop
