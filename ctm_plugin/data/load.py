"""From a folder to a scene: cameras and pictures, how they stand, what they show, near and far."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import ClassVar

from ctm_plugin.data.capture import Capture
from ctm_plugin.data.geometry import make_scene
from ctm_plugin.data.near_far import near_far, nearest
from ctm_plugin.data.points import first_points
from ctm_plugin.data.rig import Rig, rig_of
from ctm_plugin.data.to_views import develop_photographs
from ctm_plugin.scene.kinds import AUTO
from ctm_plugin.scene.views import Scene, Views


class Layout:
    """Photographs in a folder of one layout, which says how its files are read; mixed into settings with bounds."""

    layout: ClassVar[str]

    def capture(self) -> Capture:
        """Read what the folder's files say, but no pixels.

        Raises:
            DataError, ConfigError: see :meth:`load`.
        """
        raise NotImplementedError

    def rig(self) -> Rig:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # they are told when the pictures are loaded
            return self._rig(self.capture())

    def _rig(self, capture: Capture) -> Rig:
        first = next(each.picture.header for each in capture.photographs if each.picture)
        size = first[:2] if capture.shrunk else self.shrunk(first.height, first.width)
        cameras = {each.camera for each in capture.photographs}
        alone = capture.synthetic or first.alpha
        return rig_of(cameras, list(capture.c2w), size, alone, nearest(capture, self))

    def load(self) -> Scene:
        """Read the data set.

        Returns:
            The scene, named as its folder, in units of the files' poses unless ``geometry`` is forward.

        Raises:
            DataError: a file is missing or cannot be used; the message names it.
            ConfigError: ``downscale`` or ``width`` do not suit the size, ``random_matched`` lacks alpha, or the cameras
                do not face forward as ``geometry`` says.
        """
        capture = self.capture()
        geometry = self._rig(capture).geometry()[0] if self.geometry == AUTO else self.geometry
        config = replace(self, geometry=geometry)
        train, test = develop_photographs(capture, config)
        self.check(capture, train, test)
        near, far = near_far(capture, config, (train, test))
        trained = [capture.photographs[i].name for i in config.trained_on(capture.testing)]
        points = first_points(trained, *capture.clouds)
        return make_scene(capture.root, config, train, test, near, far, points)

    def check(self, capture: Capture, train: Views, test: Views) -> None:
        """Warn of views that are not what they seem to be."""
