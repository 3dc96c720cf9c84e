"""YOLOv3 and YOLOv5: anchors with objectness, written from the papers and the published layer tables."""
