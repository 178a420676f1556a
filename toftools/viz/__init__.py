"""Pictures: depth and error maps, speed against accuracy, point clouds."""
