"""DeWorldSG for ROS 2: posed RGB-D images in, a live 3D semantic scene graph out."""

__version__ = "0.2.0"
