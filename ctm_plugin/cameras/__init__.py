"""Search for the cameras of photographs, by COLMAP on brightened copies."""
