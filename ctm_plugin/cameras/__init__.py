"""Where photographs were taken from, found by COLMAP on brightened copies."""
