"""Cameras' rays, sampling, volume rendering, grids: functions of tensors."""
