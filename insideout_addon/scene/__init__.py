"""What the add-on builds in a Blender scene: splats, their display, the section plane, light and camera."""
