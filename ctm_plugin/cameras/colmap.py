"""COLMAP's pipeline by pycolmap, in stages that can be shown and stopped: keypoints, matches, poses.

Only on CPUs, which is what pycolmap's wheels are made for.
"""

from __future__ import annotations

import math
import shutil
import signal
import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float32
from torch import Tensor

from ctm_plugin.cameras.settings import MIN_PICTURES
from ctm_plugin.data.readers.picture import Header
from ctm_plugin.errors import CTMError, handling

Reconstruction = Any
"""``pycolmap.Reconstruction``; ``pycolmap`` is imported only when it is used."""
DATABASE = "database.db"
"""Name of COLMAP's database in the working folder."""
STANDARD = (100, 30, 16.0)
"""COLMAP's defaults to start a model: least matches of the first two pictures, of each other picture, and least
degrees between the first two."""
FEWER_MATCHES, CLOSER = (30, 15, 16.0), (30, 15, 6.0)
"""Starts of a model of noisy pictures and after a failed one: fewer matches, smaller angle of the first two."""
MIN_TRACK = 3
"""Least number of pictures that see a point which counts: two can agree on a place that is wrong."""
PAIR_CHUNK = 16
"""Pairs of pictures matched between two updates of the progress bar."""
FILM_DIAGONAL = 43.27
"""Diagonal of a picture on 35 mm film in millimetres."""


class Features(NamedTuple):
    """Keypoints of a picture with their descriptors.

    Attributes:
        places: ``[N, 4]`` column, row, scale, orientation of each keypoint, in pixels of the whole picture.
        descriptors: descriptors of the keypoints, of pycolmap's type, or a network's, ``[N, 64]``.
    """

    places: Float32[np.ndarray, "n 4"]
    descriptors: Any


@dataclass(frozen=True)
class Workshop:
    """A database of COLMAP's in a working folder, with the stages that fill it.

    Attributes:
        folder: folder for the files between the stages.
        threads: number of CPU threads; -1: all.
        seed: seed of COLMAP's random numbers.
    """

    folder: Path
    threads: int
    seed: int

    @property
    def database(self) -> Path:
        return self.folder / DATABASE

    def stored(self) -> int:
        """Number of pictures that are stored completely in the database."""
        database = require_pycolmap().Database.open(self.database)
        count = database.num_images()
        database.close()
        return count

    def details(self) -> int:
        """Number of keypoints of all pictures in the database."""
        database = require_pycolmap().Database.open(self.database)
        count = database.num_keypoints()
        database.close()
        return count

    def looks(self, count: int) -> list[Float32[Tensor, "n 128"]]:
        """Descriptors, of length 1, of the ``count`` largest SIFT keypoints of each picture."""
        database = require_pycolmap().Database.open(self.database)
        found = []
        for number in range(1, database.num_images() + 1):
            largest = np.argsort(-database.read_keypoints(number)[:, 2])[:count]
            found.append(F.normalize(torch.from_numpy(database.read_descriptors(number).data[largest]).float(), dim=-1))
        database.close()
        return found

    def store(self, headers: Sequence[Header], lens: str, features: Iterable[Features]) -> None:
        """Write pictures, numbered from 1 and named by their numbers: a camera for each lens and size.

        Pictures get their names back in :meth:`reconstruct`: COLMAP's lists of pairs cannot hold names with spaces.
        ``features`` are those of the pictures that are not yet :meth:`stored`.
        """
        colmap = require_pycolmap()
        begun = self.stored()
        database = colmap.Database.open(self.database)
        kinds = [(header.lens, header.height, header.width) for header in headers]
        numbers = {kind: number for number, kind in enumerate(dict.fromkeys(kinds), 1)}
        for number, feature in enumerate(features, begun + 1):
            header, camera_id = headers[number - 1], numbers[kinds[number - 1]]
            with colmap.DatabaseTransaction(database):
                if not database.exists_camera(camera_id):
                    (focal, known), size = focal_length(header), (header.width, header.height)
                    camera = colmap.Camera.create_from_model_name(camera_id, lens, focal, *size)
                    camera.has_prior_focal_length = known
                    database.write_camera(camera, use_camera_id=True)
                    rig = colmap.Rig(rig_id=camera_id)
                    rig.add_ref_sensor(camera.sensor_id)
                    database.write_rig(rig, use_rig_id=True)
                image = colmap.Image(name=str(number), camera_id=camera_id, image_id=number)
                database.write_image(image, use_image_id=True)
                frame = colmap.Frame(frame_id=number, rig_id=camera_id)
                frame.add_data_id(image.data_id)
                database.write_frame(frame, use_frame_id=True)
                database.write_keypoints(number, feature.places)
                if not isinstance(feature.descriptors, Tensor):
                    database.write_descriptors(number, feature.descriptors)
        database.close()

    def match(
        self,
        pairs: Sequence[tuple[int, int]],
        done: Callable[[int], None],
        nearest: Callable[[int, int], Any] | None = None,
    ) -> int:
        """Match the keypoints of pairs of pictures, given by number, and keep matches that one camera motion explains.

        ``done`` is called with the number of pairs that have been matched, those of a stopped search included.
        Returned is the number of pairs with verified matches. ``nearest`` finds the rows of keypoints that match,
        ``[M, 2]``; by default COLMAP compares SIFT's.
        """
        colmap = require_pycolmap()
        matching, checking = colmap.FeatureMatchingOptions(), colmap.TwoViewGeometryOptions()
        matching.num_threads, checking.ransac.random_seed = self.threads, self.seed
        listed = colmap.ImportedPairingOptions()
        listed.match_list_path = self.folder / "pairs.txt"
        for start in range(0, len(pairs), PAIR_CHUNK):
            chunk = pairs[start : start + PAIR_CHUNK]
            listed.match_list_path.write_text("".join(f"{first} {second}\n" for first, second in chunk))
            if nearest is None:
                colmap.match_image_pairs(self.database, matching, listed, checking, colmap.Device.cpu)
            else:
                database = colmap.Database.open(self.database)
                for pair in (pair for pair in chunk if not database.exists_matches(*pair)):
                    database.write_matches(*pair, np.asarray(nearest(*pair), np.uint32))
                database.close()
                colmap.verify_matches(self.database, listed.match_list_path, checking)
            done(start + len(chunk))
        database = colmap.Database.open(self.database)
        _, inliers = database.read_two_view_geometry_num_inliers()
        database.close()
        return sum(count >= checking.min_num_inliers for count in inliers)

    def with_headers(self, headers: Sequence[Header], lens: str, pairs: Sequence[tuple[int, int]]) -> Workshop:
        """Copy keypoints and matches into a folder below, with these headers' lenses, by which matches are verified."""
        copy = replace(self, folder=self.folder / "lenses")
        shutil.rmtree(copy.folder, ignore_errors=True)  # a search that was stopped may have found other lenses
        copy.folder.mkdir()
        database = require_pycolmap().Database.open(self.database)
        places = (database.read_keypoints(number) for number in range(1, len(headers) + 1))
        copy.store(headers, lens, (Features(each, torch.empty(0)) for each in places))
        copy.match(pairs, lambda _: None, database.read_matches)
        database.close()
        return copy

    def reconstruct(
        self, names: Sequence[str], start: tuple[int, int, float], done: Callable[[int], None]
    ) -> Reconstruction | None:
        """Reconstruct incrementally: give the model with most observations; ``None`` where not even two pictures fit.

        ``start`` has the numbers of :data:`STANDARD`; ``done`` is called with the number of pictures that have a pose.
        """
        colmap = require_pycolmap()
        options = colmap.IncrementalPipelineOptions()
        options.num_threads, options.min_model_size, options.extract_colors = self.threads, MIN_PICTURES, False
        mapper = options.mapper
        mapper.init_min_num_inliers, mapper.abs_pose_min_num_inliers, mapper.init_min_tri_angle = start
        for part in (options, options.mapper, options.triangulation):
            part.random_seed = self.seed
        standing = [0]

        def first_two() -> None:
            standing[0] = 2
            done(2)

        def another() -> None:
            standing[0] += 1
            done(standing[0])

        with tempfile.TemporaryDirectory(dir=self.folder) as models:
            mapped = colmap.incremental_mapping(
                self.database, self.folder, models, options,
                initial_image_pair_callback=first_two, next_image_callback=another,
            )  # fmt: skip
        if not mapped:
            return None
        model = max(mapped.values(), key=lambda each: (count_observations(each), each.num_reg_images()))
        for number in model.images:
            model.image(number).name = names[number - 1]
        return model


def count_observations(model: Reconstruction) -> int:
    """Number of a model's observations of points that at least :data:`MIN_TRACK` pictures see."""
    lengths = (point.track.length() for point in model.points3D.values())
    return sum(length for length in lengths if length >= MIN_TRACK)


def adjust(model: Reconstruction, threads: int, tolerance: float = 1e-6) -> None:
    """Adjust a whole model by bundle adjustment: a robust loss from a pixel on; two cameras fix the gauge.

    It ends when a step reduces the error by less than the share ``tolerance``.
    """
    colmap = require_pycolmap()
    options, what = colmap.BundleAdjustmentOptions(), colmap.BundleAdjustmentConfig()
    options.print_summary = False
    options.ceres.loss_function_type = colmap.LossFunctionType.CAUCHY
    solver = options.ceres.solver_options
    solver.num_threads, solver.function_tolerance = threads, tolerance
    for view in model.reg_image_ids():
        what.add_image(view)
    what.fix_gauge(colmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    colmap.create_default_bundle_adjuster(options, what, model).solve()


def require_pycolmap() -> ModuleType:
    """Import pycolmap, set to print only errors; a message names the extra that installs it."""
    try:
        with handling(signal.SIG_DFL, signal.SIGTERM):  # pycolmap would print its C++ stack at SIGTERM
            import pycolmap  # after Pillow, imported above: the zlib that its wheel shows would be taken for Pillow's
    except ImportError as error:
        raise CTMError(f"finding cameras needs pycolmap: pip install -e '.[colmap]' ({error})") from error
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    return pycolmap


def focal_length(header: Header) -> tuple[float, bool]:
    """Initial focal length in pixels, by EXIF, else 1.2 times the longer side; and whether it is EXIF's."""
    film = header.lens.film
    if film is None:
        return 1.2 * max(header.height, header.width), False
    return film * math.hypot(header.height, header.width) / FILM_DIAGONAL, True


def extract(picture: Float32[np.ndarray, "h w"], scale: int, pooled: bool) -> Features:
    """Find SIFT keypoints of a picture, grey in [0, 1], that is ``scale`` times smaller than the whole one.

    ``pooled``: descriptors are means over several sizes of the keypoints' surroundings.
    """
    colmap = require_pycolmap()
    options = colmap.FeatureExtractionOptions()
    options.sift.domain_size_pooling = pooled
    extractor = colmap.FeatureExtractor.create(options, colmap.Device.cpu)
    keypoints, descriptors = extractor.extract_from_float32_array(np.ascontiguousarray(picture))
    places = colmap.keypoints_to_matrix(keypoints)[:, :4] * np.array([scale, scale, scale, 1], dtype=np.float32)
    return Features(places, descriptors)
