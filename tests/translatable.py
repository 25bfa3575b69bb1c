"""What of our texts Blender can translate: those of registered classes, those that are marked in the code, and errors
and findings.

Loaded by file path, as panel_drawing.py is. A text is (context, English).
"""

from __future__ import annotations

import ast
import builtins
import re
import string
from functools import cache
from pathlib import Path

import bpy
from bpy.app.translations import contexts

_ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("insideout_addon", "operators", "panels")
# What of the core Blender does not run: its errors, and what else it tells, are for the command line and for scripts.
NOT_OF_BLENDER = ("bench", "cli.py", "compare", "naf", "phantoms", "plotting.py", "terminal.py")
# Blender's own names for what translates, and for what only marks.
_MARKS = ("iface_", "rpt_", "tip_", "n_")
# Names of keywords and functions whose text Blender translates by itself: the index of the text among the arguments.
_KEYWORDS = ("text", "confirm_text", "heading", "title")
# Of what tells a capture's findings: how many of its arguments, behind the file, are templates.
_FINDINGS = {"CaptureProblem": 2, "info": 1, "warning": 2}
_FUNCTIONS = {"wrapped": 1, "_row": 1, "poll_message_set": 0, "report": 1}
_LETTERS, _WORD, _SENTENCE = (
    re.compile(r"[A-Za-z]{2,}"),
    re.compile(r"[A-Za-z]{3,}"),
    re.compile(r"[A-Za-z]{2,} +[A-Za-z]{2,}"),
)


def catalogue():
    """Everything that can be translated; the add-on is registered."""
    return class_texts(shown_classes()) | code_texts() | core_texts()


def shown_classes():
    """The classes whose labels and tooltips users see."""
    from insideout import operators, panels
    from insideout.insideout_addon import preferences, properties

    settings = (properties.InsideOutSection, properties.InsideOutEffects, properties.InsideOutSettings)
    shown = (*settings, properties.InsideOutJobState)
    return (*operators.CLASSES, *panels.CLASSES, *preferences.CLASSES, *shown)


def class_texts(classes):
    """Of registered classes: their labels and descriptions, and those of the properties that they declare."""
    found = set()
    for cls in classes:
        rna = registered(cls)
        if issubclass(cls, bpy.types.Panel):
            found.add((contexts.default, cls.bl_label))
        if issubclass(cls, bpy.types.Operator):
            found |= {(rna.translation_context, rna.name), (contexts.default, rna.description)}
        for name in getattr(cls, "__annotations__", {}):
            found |= _property_texts(rna.properties[name])
    return {(context, text) for context, text in found if _WORD.search(text)}


def registered(cls):
    """With the properties; a class of an operator does not know its own."""
    if not issubclass(cls, bpy.types.Operator):
        return cls.bl_rna
    group, name = cls.bl_idname.split(".")
    return getattr(getattr(bpy.ops, group), name).get_rna_type()


def is_shown(declared):
    """Whether a property is shown somewhere: else it has no name."""
    return declared.name != declared.identifier and not declared.is_hidden


def _property_texts(declared):
    if not is_shown(declared):
        return set()
    texts = {declared.name, declared.description}
    if declared.type == "ENUM":
        texts |= {text for item in declared.enum_items for text in (item.name, item.description)}
    return {(declared.translation_context, text) for text in texts}


@cache
def sources():
    """Path and syntax tree of each file of the add-on."""
    return _parsed(path for folder in FOLDERS for path in sorted((_ROOT / folder).rglob("*.py")))


@cache
def core_sources():
    """As `sources`, of what of the core Blender and the engine that it starts run; and of what makes that engine."""
    core = _ROOT / "core"
    paths = [path for path in sorted(core.rglob("*.py")) if path.relative_to(core).parts[0] not in NOT_OF_BLENDER]
    return _parsed([*paths, _ROOT / "insideout_addon" / "engine" / "setup_environment.py"])


def _parsed(paths):
    return [(path.relative_to(_ROOT), ast.parse(path.read_text("utf-8"))) for path in paths]


@cache
def code_texts():
    """Literals in the code: those that are marked, those of our errors, and those that Blender translates by itself."""
    return {text for _, tree in sources() for text in _tree_texts(tree) if _WORD.search(text[1])}


@cache
def core_texts():
    """The templates of the core's errors and of what else it tells."""
    found = (text for _, tree in core_sources() for _, templates in _told(tree) for text in templates)
    return {(contexts.default, text) for text in found if text is not None and _has_words(text)}


def core_parts():
    """What the engine calls the parts of its stages, where that is written down."""
    found = set()
    for path, tree in core_sources():
        calls = [call for call in _calls(tree) if _called(call) in ("Progress", "Task", "progress")]
        given = [call.args[1] for call in calls if len(call.args) > 1 and _called(call) != "progress"]
        given += [keyword.value for call in calls for keyword in call.keywords if keyword.arg == "part"]
        # What photos are turned into by themselves, as a comparison does it, is no run's.
        found |= {part.value for part in given if _is_text(part) and path.name != "stereo.py"}
    return found - {""}


def effect_units():
    """What strengths of effects are told in."""
    assigned = [
        (target, value)
        for path, tree in core_sources()
        if path.parts[1] == "effects"
        for node in tree.body
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Tuple) and isinstance(node.targets[0], ast.Tuple)
        for target, value in zip(node.targets[0].elts, node.value.elts, strict=True)
    ]
    return {value.value for target, value in assigned if _name_of(target) == "_UNIT"}


def _has_words(template):
    """Whether there is more in it than places."""
    return any(_LETTERS.search(literal) for literal, _, _, _ in string.Formatter().parse(template))


def _told(tree, constants=None):
    """Each call that tells something and the templates it may have; None for what only running it tells."""
    constants = {**(constants or {}), **_constants(tree)}
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield from _told(node, constants)
            continue
        yield from _told(node, constants)
        if isinstance(node, ast.Call):
            given = _templates_of(node)
            texts = [] if _passes_on(node, given) else _possible(given, constants)
            # What stages say of their progress may be a plain text, where there are no values in it.
            said = _possible([keyword.value for keyword in node.keywords if keyword.arg == "message"], constants)
            texts += [one for one in said if _is_text(one) or isinstance(one, ast.JoinedStr)]
            if texts:
                yield node, [one.value if _is_text(one) else None for one in texts]


def _templates_of(call):
    """The arguments that are templates."""
    name = _name_of(call.func)
    if name in _FINDINGS:
        return call.args[1 : 1 + _FINDINGS[name]]
    if name == "Told" or _is_our_error(name):
        return call.args[:1]
    return []


def _passes_on(call, given):
    """Whether it has its templates, with all their values, from somebody else, who is looked at there."""
    passed = all(isinstance(one, ast.Name | ast.Attribute) for one in given)
    return passed and any(keyword.arg is None for keyword in call.keywords)


def _possible(expressions, constants):
    """What they can be."""
    choices = (choice for one in expressions for choice in _alternatives(one))
    return [value for choice in choices for value in constants.get(_name_of(choice), [choice])]


def _constants(scope):
    """What is assigned to names in a module, or anywhere in a function; of a name that is used twice both."""
    if isinstance(scope, ast.FunctionDef):
        nodes = ast.walk(scope)
    else:
        nodes = scope.body if isinstance(scope, ast.Module) else []
    found = {}
    for node in nodes:
        if isinstance(node, ast.Assign):
            for target in filter(_name_of, node.targets):
                found.setdefault(_name_of(target), []).extend(_alternatives(node.value))
    return found


def _tree_texts(tree):
    for call in _calls(tree):
        name, context = _called(call), contexts.default
        if _is_our_error(name) and call.args:
            given = call.args[:1]
        elif name in _MARKS and call.args:
            if len(call.args) > 1:
                context = getattr(contexts, call.args[1].attr)
            given = call.args[:1]
        else:
            given = list(_shown(call))
            context = contexts.operator_default if name == "operator" else context
        for expression in given:
            yield from ((context, part.value) for part in _alternatives(expression) if _is_text(part))


def untranslatable(known):
    """Where panels and operators put together a text, or show one, that no translation can reach: "file:line text".

    Args:
        known: the texts of a catalogue.
    """
    english = {text for _, text in known}
    for path, tree in sources():
        if path.parts[0] == "insideout_addon":
            continue
        passed_over = {id(part) for node in ast.walk(tree) if _stays_english(node) for part in ast.walk(node)}
        for node in ast.walk(tree):
            if id(node) in passed_over:
                continue
            if isinstance(node, ast.JoinedStr):
                words = " ".join(part.value for part in node.values if isinstance(part, ast.Constant))
                if _WORD.search(words):
                    yield f"{path}:{node.lineno} {words}"
            elif _is_text(node) and _SENTENCE.search(node.value) and node.value not in english:
                yield f"{path}:{node.lineno} {node.value}"


def untranslatable_errors():
    """Where an error of ours is put together before it is made, or shown as it was made: "file:line"."""
    for path, tree in sources():
        for handler in ast.walk(tree):
            if isinstance(handler, ast.ExceptHandler) and handler.name and path.name != "error_text.py":
                shown = [call for call in _calls(handler) if _called(call) == "str" and call.args]
                yield from (f"{path}:{call.lineno}" for call in shown if _name_of(call.args[0]) == handler.name)
        for call in _calls(tree):
            if _is_our_error(_called(call)) and call.args:
                parts = _alternatives(call.args[0])
                # A name is that of a text which is marked where it is written.
                if not all(_is_text(part) or _name_of(part) for part in parts):
                    yield f"{path}:{call.lineno}"
    for path, tree in core_sources():
        yield from (f"{path}:{call.lineno}" for call, templates in _told(tree) if None in templates)


def misfilled_errors():
    """Where a template of the core has a place that no value is given for, or braces that stay two: "file:line"."""
    for path, tree in core_sources():
        for call, templates in _told(tree):
            given = {keyword.arg for keyword in call.keywords}
            known = [text for text in templates if text is not None]
            # What is given as **values only running it tells.
            unfilled = None not in given and not all(_places(text) <= given for text in known)
            # Braces are doubled for `format`, and nothing is formatted without values.
            doubled = not given and _name_of(call.func) != "CaptureProblem" and any("{{" in text for text in known)
            if unfilled or doubled:
                yield f"{path}:{call.lineno}"


def _places(template):
    return {name for _, name, _, _ in string.Formatter().parse(template) if name is not None}


def _is_our_error(name):
    """Whether a user sees it as it is: Python's own are for programmers, or are caught and told in other words."""
    return name.endswith("Error") and not hasattr(builtins, name)


def _stays_english(node):
    """Docstrings; and what is declared of classes, which `class_texts` finds at the classes themselves."""
    docstring = isinstance(node, ast.Expr) and _is_text(node.value)
    declared = isinstance(node, ast.AnnAssign) or (isinstance(node, ast.Call) and _called(node).endswith("Property"))
    labels = isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "").startswith("bl_")
    return docstring or declared or labels


def _is_text(node):
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


def _name_of(node):
    return getattr(node, "id", "")


def _calls(tree):
    return [node for node in ast.walk(tree) if isinstance(node, ast.Call)]


def _called(call):
    return getattr(call.func, "attr", getattr(call.func, "id", ""))


def _shown(call):
    """The expressions of texts that a call shows."""
    yield from (keyword.value for keyword in call.keywords if keyword.arg in _KEYWORDS)
    place = _FUNCTIONS.get(_called(call))
    if place is not None and len(call.args) > place:
        yield call.args[place]


def _alternatives(expression):
    if isinstance(expression, ast.IfExp):
        return [*_alternatives(expression.body), *_alternatives(expression.orelse)]
    return [expression]
