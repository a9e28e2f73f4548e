"""Several optimizers behind one step, their schedules, Adam of voxel tables."""
