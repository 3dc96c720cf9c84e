"""Camera: meshes, visibility, shading, weather and sensors."""
