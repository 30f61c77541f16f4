"""Where a photograph or a scan was taken: poses in the frame of the map."""
