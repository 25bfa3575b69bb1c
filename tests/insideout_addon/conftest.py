"""Imports bpy before any test does: bmesh, mathutils and the like are only there then."""

import bpy  # noqa: F401
