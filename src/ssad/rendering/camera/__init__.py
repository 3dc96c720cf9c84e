"""The camera: meshes, visibility, shading, weather and sensors."""
