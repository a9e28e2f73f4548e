"""The layout of Synthetic-NeRF: ``transforms_{train,test}.json`` and RGBA pictures; also what our renderer writes."""

from __future__ import annotations

from ctm_plugin.data.capture import Capture
from ctm_plugin.data.load import Layout
from ctm_plugin.data.readers.folders import inside
from ctm_plugin.data.readers.frames import angle_alone
from ctm_plugin.data.readers.layouts import TEST, TRAIN, open_layout
from ctm_plugin.data.readers.records import read_record
from ctm_plugin.data.settings import BlenderSettings
from ctm_plugin.data.transforms import capture_of


class BlenderConfig(Layout, BlenderSettings):
    layout = "blender"

    def capture(self) -> Capture:
        """Read a data set in Blender layout.

        Files that give more of their cameras than ``camera_angle_x`` are read as by ``dataset=transforms``. Of others,
        views are in the files' order, and near and far of 2 and 6 give way, with a warning, to bounds from the cameras
        where they do not suit these.

        Pictures are shrunk with premultiplied alpha, dimmed, training views given noise, and rounded to 8 bits. Test
        views have depth where ``transforms_test.json`` holds ``depth_scale`` and every frame a ``depth_file_path``:
        16-bit grey, ``depth = code x depth_scale`` along the ray, code 0 for nothing.

        The scene's exposure is ``exposure`` times the ``light`` in the ``settings.json`` of our renderer, where there
        is one.
        """
        root = open_layout(self.root, self.layout)
        files = [(read_record(inside(root, name)), name == TEST) for name in (TRAIN, TEST)]
        return capture_of(root, files, synthetic=all(angle_alone(root / name) for name in (TRAIN, TEST)))
