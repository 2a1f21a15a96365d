"""A generated furnished room: meshes, textures, light, camera, sensor and ground truth."""
