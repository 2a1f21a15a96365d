"""A furnished room made of code: meshes, textures, light, camera, sensor and ground truth."""
