"""The node group that says which of many splats are worth an ellipsoid; the others stay points."""

from __future__ import annotations

from functools import reduce

import bpy

from .cut_slots import HEIGHTS
from .node_tree import InputRow, OutputRow, Sockets, TreeBuilder, row, shared_group

# A point attribute that scripts and "Ellipsoids for Selected" set: these first.
CHOSEN = "ellipsoid"
# Splats that several planes cut become meshes of their own, which take fifty times the memory of an instance.
_MESHES = 0.02
_INPUTS: tuple[InputRow, ...] = (
    row("Geometry", "Geometry"),
    row("Most", "Int", "As many splats are worth an ellipsoid"),
    row("Large From", "Float", "Standard deviation, mm"),
    row("Near Cuts", "Float", "mm"),
    row("Box", "Object", "From -1 to 1 in its own frame"),
    row("Camera", "Object"),
    row("Gap", "Float", "From a splat's center to the nearest plane, mm"),
    row("Crossing", "Float", "How many planes cut a splat"),
    row("Hidden", "Float", "Above 0 where a plane hides all of a splat"),
)
_WORTH_INPUTS = tuple(given for given in _INPUTS if given[0] != "Most")
_OUTPUTS: tuple[OutputRow, ...] = (("Ellipsoids", "NodeSocketGeometry"), ("Points", "NodeSocketGeometry"))
_WORTH, _TAKEN = "insideout_worth", "insideout_taken"
# What is not worth one has less than all others.
_NONE = -1.0
# Sizes within so many doublings are told apart; equal ones, within two percent, by chance.
_OCTAVES, _CHANCE = 80.0, 4e-4


def mixed_group() -> bpy.types.NodeTree:
    """The shared node group, built on first use: points to those worth an ellipsoid, at most so many, and the rest,
    less those that a plane has passed.

    First those that the user has chosen, by the attribute `CHOSEN` or by a box; then those at cuts; then large ones,
    as seen from the camera where there is one. Of each kind the larger first.
    """
    return shared_group("InsideOut Mixed", _INPUTS, _build, _OUTPUTS)


def _build(b: TreeBuilder, given: Sockets) -> list[bpy.types.NodeSocket]:
    """Puts splats in order only where not all that are worth an ellipsoid can have one: a moving plane asks again and
    again."""
    fields = {name: given[name] for name, *_ in _WORTH_INPUTS}
    worthy = b.group(worthy_group(), fields)[0]
    all_worthy = b.stored(given["Geometry"], _TAKEN, "BOOLEAN", worthy)
    taken = b.attribute(_TAKEN, "BOOLEAN")
    too_many = b.compare("GREATER_THAN", b.statistic(all_worthy, taken, "Sum"), given["Most"])
    put_in_order = b.boolean("OR", too_many, _several_planes(b, given["Geometry"]))
    worth = b.group(worth_group(), fields)[0]
    ranked = {"Worth": worth, "Most": given["Most"], "Crossing": given["Crossing"]}
    first = b.group(_first_group(), {"Geometry": all_worthy, **ranked})[0]
    marked = b.switch(put_in_order, all_worthy, first)
    ellipsoids = b.deleted(marked, b.boolean("NOT", taken))
    # Points are copied once, without those that a plane has passed.
    points = b.deleted(marked, b.boolean("OR", taken, b.compare("LESS_THAN", given["Gap"], 0.0)))
    return [b.without(shown, _TAKEN) for shown in (ellipsoids, points)]


def _first_group() -> bpy.types.NodeTree:
    """Marks the splats that are worth most, as many as there may be, by `_TAKEN`."""
    inputs = [row("Geometry", "Geometry"), row("Worth", "Float"), row("Most", "Int"), row("Crossing", "Float")]
    return shared_group("InsideOut First", inputs, _build_first)


def _build_first(b: TreeBuilder, given: Sockets) -> list[bpy.types.NodeSocket]:
    scored = b.stored(given["Geometry"], _WORTH, "FLOAT", given["Worth"])
    worth = b.attribute(_WORTH, "FLOAT")
    bar = b.group(_bar_group(), {"Geometry": scored, "Worth": worth, "Most": given["Most"]})[0]
    meshes = b.compare("GREATER_THAN", given["Crossing"], 1.5)
    of_meshes = b.switch(meshes, _NONE, worth, "FLOAT")
    few = b.math("FLOOR", b.math("MULTIPLY", given["Most"], _MESHES))
    own = b.group(_bar_group(), {"Geometry": scored, "Worth": of_meshes, "Most": few})[0]
    several = b.switch(meshes, bar, b.math("MAXIMUM", bar, own), "FLOAT")
    needed = b.switch(_several_planes(b, scored), bar, several, "FLOAT")
    taken = b.stored(scored, _TAKEN, "BOOLEAN", b.compare("GREATER_THAN", worth, needed))
    return [b.without(taken, _WORTH)]


def _several_planes(b: TreeBuilder, geometry: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """Whether more than one plane may cut a splat: one answer for all."""
    more = [b.exists(geometry, height) for height in HEIGHTS[1:]]
    return reduce(lambda any_of, one: b.boolean("OR", any_of, one), more)


def worthy_group() -> bpy.types.NodeTree:
    """Whether a splat is worth an ellipsoid at all."""
    return shared_group("InsideOut Worthy", _WORTH_INPUTS, _build_worthy, [("Worthy", "NodeSocketBool")])


def _build_worthy(b: TreeBuilder, given: Sockets) -> list[bpy.types.NodeSocket]:
    wanted = reduce(lambda any_of, one: b.boolean("OR", any_of, one), _kinds(b, given, _size(b, given)))
    return [b.boolean("AND", wanted, b.compare("LESS_THAN", given["Hidden"], 0.5))]


def _size(b: TreeBuilder, given: Sockets) -> bpy.types.NodeSocket:
    return b.math("MULTIPLY", b.attribute("radius", "FLOAT"), _nearness(b, given))


def _kinds(b: TreeBuilder, given: Sockets, size: bpy.types.NodeSocket) -> tuple[bpy.types.NodeSocket, ...]:
    """Whether a splat is large, at a cut, chosen."""
    large = b.compare("GREATER_EQUAL", size, given["Large From"])
    cut = b.boolean(
        "OR",
        b.compare("GREATER_THAN", given["Crossing"], 0.5),
        b.compare("LESS_THAN", given["Gap"], given["Near Cuts"]),
    )
    return large, cut, b.boolean("OR", b.attribute(CHOSEN, "BOOLEAN"), _in_box(b, given["Box"]))


def worth_group() -> bpy.types.NodeTree:
    """2 and more where the user has chosen a splat, 1 and more near cuts, 0 and more for a large one, else `_NONE`."""
    return shared_group("InsideOut Worth", _WORTH_INPUTS, _build_worth, [("Worth", "NodeSocketFloat")])


def _build_worth(b: TreeBuilder, given: Sockets) -> list[bpy.types.NodeSocket]:
    size, kind = _size(b, given), None
    for level, which in enumerate(_kinds(b, given, size)):
        kind = b.switch(which, _NONE if kind is None else kind, float(level), "FLOAT")
    octave = b.math("LOGARITHM", b.math("MAXIMUM", size, 1e-12), 2.0)
    place = b.math("ADD", b.math("DIVIDE", octave, _OCTAVES), 0.5)
    chance = b.add("FunctionNodeRandomValue", {"Max": _CHANCE}, data_type="FLOAT")
    drawn = next(socket for socket in chance.outputs if socket.enabled)
    within = b.math("MINIMUM", b.math("MAXIMUM", b.math("ADD", place, drawn), 0.0), 0.999)
    none = b.boolean("OR", b.compare("LESS_THAN", kind, 0.0), b.compare("GREATER_THAN", given["Hidden"], 0.5))
    return [b.switch(none, b.math("ADD", kind, within), _NONE, "FLOAT")]


def _in_box(b: TreeBuilder, box: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """Whether a splat's centre is in a box; never where there is none."""
    info = b.add("GeometryNodeObjectInfo", {"Object": box}, transform_space="RELATIVE")
    inverse = b.add("FunctionNodeInvertMatrix", {0: info.outputs["Transform"]}).outputs[0]
    position = b.add("GeometryNodeInputPosition").outputs[0]
    local = b.vector("ABSOLUTE", b.add("FunctionNodeTransformPoint", {0: position, 1: inverse}).outputs[0])
    sides = b.add("ShaderNodeSeparateXYZ", {0: local}).outputs
    farthest = b.math("MAXIMUM", sides["X"], b.math("MAXIMUM", sides["Y"], sides["Z"]))
    return b.switch(_is_there(b, info), False, b.compare("LESS_EQUAL", farthest, 1.0), "BOOLEAN")


def _nearness(b: TreeBuilder, given: Sockets) -> bpy.types.NodeSocket:
    """How much larger the camera sees a splat than one of its size in the middle of the model; 1 without a camera."""
    info = b.add("GeometryNodeObjectInfo", {"Object": given["Camera"]}, transform_space="RELATIVE")
    position = b.add("GeometryNodeInputPosition").outputs[0]
    # Not a bounding box: Blender may have kept that of before the splats were moved.
    middle = b.statistic(given["Geometry"], position, "Mean", "FLOAT_VECTOR")
    away = b.vector("DISTANCE", position, info.outputs["Location"])
    nearer = b.math("DIVIDE", b.vector("DISTANCE", middle, info.outputs["Location"]), b.math("MAXIMUM", away, 1e-9))
    return b.switch(_is_there(b, info), 1.0, nearer, "FLOAT")


def _is_there(b: TreeBuilder, info: bpy.types.Node) -> bpy.types.NodeSocket:
    """Whether an input has an object: one that is not there has no size."""
    return b.compare("GREATER_THAN", b.vector("LENGTH", info.outputs["Scale"]), 0.0)


def _bar_group() -> bpy.types.NodeTree:
    """What a splat has to be worth more than for no more than so many to be left, of those that are worth one."""
    inputs = [row("Geometry", "Geometry"), row("Worth", "Float"), row("Most", "Int")]
    return shared_group("InsideOut Bar", inputs, _build_bar, [("Bar", "NodeSocketFloat")])


def _build_bar(b: TreeBuilder, given: Sockets) -> list[bpy.types.NodeSocket]:
    # Sorting moves all that points have: these have no more than what they are sorted by.
    splats = b.add("GeometryNodeAttributeDomainSize", {"Geometry": given["Geometry"]}, component="POINTCLOUD")
    index = b.add("GeometryNodeInputIndex").outputs[0]
    of_splat = {"Geometry": given["Geometry"], "Value": given["Worth"], "Index": index}
    taken = b.add("GeometryNodeSampleIndex", of_splat, data_type="FLOAT", domain="POINT").outputs[0]
    bare = b.add("GeometryNodePoints", {"Count": splats.outputs["Point Count"]}).outputs[0]
    scored, worth = b.stored(bare, _WORTH, "FLOAT", taken), b.attribute(_WORTH, "FLOAT")
    candidates = b.deleted(scored, b.compare("LESS_THAN", worth, 0.5 * _NONE))
    falling = {"Geometry": candidates, "Sort Weight": b.math("MULTIPLY", worth, -1.0)}
    ordered = b.add("GeometryNodeSortElements", falling, domain="POINT").outputs[0]
    first_out = {"Geometry": ordered, "Value": worth, "Index": given["Most"]}
    bar = b.add("GeometryNodeSampleIndex", first_out, data_type="FLOAT", domain="POINT").outputs[0]
    count = b.statistic(given["Geometry"], b.compare("GREATER_THAN", given["Worth"], 0.5 * _NONE), "Sum")
    return [b.switch(b.compare("GREATER_THAN", count, given["Most"]), 0.5 * _NONE, bar, "FLOAT")]
