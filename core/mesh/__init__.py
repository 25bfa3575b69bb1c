"""From a volume to a mesh: surfaces, colours, files, mass properties, section contours.

Importable with numpy alone; trimesh, scikit-image and scipy are loaded by the functions that need them.
"""

from .color import color_mesh
from .contours import contours
from .glb import write_glb
from .mass import MassProperties, gaussian_mass_properties, mass_properties
from .surface import extract_mesh

__all__ = [
    "MassProperties",
    "color_mesh",
    "contours",
    "extract_mesh",
    "gaussian_mass_properties",
    "mass_properties",
    "write_glb",
]
