"""What an observer learns, each lesson once and from any source: the map, a flow, the calibration."""
