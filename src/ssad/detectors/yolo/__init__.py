"""YOLOv3 and YOLOv5 detectors with anchors and objectness, written from the papers and published layer tables."""
