"""Triangle meshes: data structure, readers and writers."""
