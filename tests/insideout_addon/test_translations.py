"""Every text that a user sees goes through Blender's translation, and there is one into German."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import shutil
import string
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from bpy.app.translations import contexts

from insideout.core.capture.findings import name_some, warning
from insideout.core.capture.volumes import RELATIVE, read_volume
from insideout.core.effect_names import PHOTO_EFFECTS, TOLD, XRAY_EFFECTS
from insideout.core.endings import endings
from insideout.core.errors import CaptureError, DiskFullError, SettingError
from insideout.core.told import Told
from insideout.insideout_addon import translations
from insideout.insideout_addon.engine import job
from insideout.insideout_addon.engine.progress_text import PARTS
from insideout.insideout_addon.error_text import error_text
from insideout.insideout_addon.physics.cells import choose_seeds
from insideout.insideout_addon.remembered import forget
from insideout.insideout_addon.scene.importing import densities_are_relative, warnings_of
from insideout.insideout_addon.scene.provenance_text import EFFECT_UNITS
from insideout.insideout_addon.told_text import told_text

_HERE = Path(__file__).parent
_PROGRAM = os.environ.get("BLENDER") or shutil.which("blender")


def _load(name):
    spec = importlib.util.spec_from_file_location(name, _HERE.parent / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


translatable = _load("translatable")


@pytest.fixture
def catalogue(blender):
    return translatable.catalogue()


@pytest.fixture
def in_german(monkeypatch):
    """Has the add-on's modules look texts up as Blender does, whose wheels are without languages."""
    texts = translations.texts_of("de_DE")

    def look_up(text, context=contexts.default):
        return texts.get((context, text), text)

    for name, module in list(sys.modules.items()):
        if name.startswith("insideout."):
            for function in {"iface_", "rpt_"} & set(vars(module)):
                monkeypatch.setattr(module, function, look_up)


def test_no_text_of_panels_and_operators_is_out_of_reach(catalogue):
    assert list(translatable.untranslatable(catalogue)) == []


def test_no_error_is_out_of_reach():
    assert list(translatable.untranslatable_errors()) == []


def test_each_place_of_the_cores_templates_has_its_value():
    assert list(translatable.misfilled_errors()) == []


def test_each_part_of_the_engines_stages_has_a_name():
    assert {"sfm", "hull", "held-out views"} <= translatable.core_parts() <= set(PARTS)


def test_each_unit_of_an_effect_has_a_name():
    assert {"px", "% of the peak"} <= translatable.effect_units() <= set(EFFECT_UNITS)


def test_each_effect_has_a_name_inside_of_sentences():
    assert set(TOLD) == set(PHOTO_EFFECTS + XRAY_EFFECTS)
    assert all(name == told for name, told in TOLD.items())


def test_texts_are_of_one_line(catalogue):
    """A tooltip's second line begins with other blanks from Python 3.13 on, where its translation is not found."""
    assert [text for _, text in catalogue if "\n" in text] == []


def test_the_catalogue_knows_texts_of_each_kind(catalogue):
    assert {
        (contexts.operator_default, "Add Section Plane"),  # an operator's label
        (contexts.operator_default, "Weigh..."),  # a button's own text
        (contexts.default, "Cut the model with one more plane that you can move and turn"),  # a tooltip
        (contexts.default, "Section"),  # a panel
        (contexts.default, "Slab (mm)"),  # a property
        (contexts.default, "Along Sections"),  # one of an operator's choices
        (contexts.default, "Import a model first"),  # why a button is greyed out
        (contexts.default, "{count} contours in mm saved as {file}"),  # a report that is put together
        (contexts.default, "{file} is missing"),  # a label that is put together
        (contexts.default, "{model} was not weighed yet; press Weigh first."),  # an error
        (contexts.default, "{path}: is a folder; give the file a name."),  # an error of an operator
        (contexts.default, "{path}: is not a .ply file; choose a Gaussian .ply."),  # an error of the core
        (contexts.default, "is the only photo"),  # what is wrong with a capture
        (contexts.default, "take at least 20 photos all around the object, each overlapping the next"),  # what to do
        (contexts.default, "{count} photos are few"),  # what a check finds
        (contexts.default, "{told}; less than {least:g} px does no harm."),  # what is said of an effect
        (contexts.default, "{names} and {more} more"),  # a text inside of others
        (contexts.default, "Installing packages: {done} of {count}"),  # what making the environment says
    } <= catalogue


def test_german_is_complete(catalogue):
    german = {key for key, text in translations.texts_of("de_DE").items() if text}
    assert sorted(catalogue - german) == []


@pytest.mark.parametrize("language", translations.languages())
def test_no_translation_is_of_a_text_that_is_gone(catalogue, language):
    assert sorted(set(translations.texts_of(language)) - catalogue) == []


@pytest.mark.parametrize("language", translations.languages())
def test_translations_have_the_places_of_the_english(language):
    def places(text):
        return sorted((name, form) for _, name, form, _ in string.Formatter().parse(text) if name is not None)

    for (_, english), text in translations.texts_of(language).items():
        assert places(text) == places(english), text


@pytest.mark.parametrize("language", translations.languages())
def test_translations_keep_blenders_style(language):
    """An ellipsis tells that a dialog follows; only sentences that have a full stop in English have one."""
    assert re.fullmatch(r"[a-z]{2,3}(_[A-Z]{2})?", language)
    for (_, english), text in translations.texts_of(language).items():
        assert text == text.strip()
        assert text.endswith("...") == english.endswith("...")
        assert text.endswith(".") == english.endswith("."), text


def test_the_files_are_in_order():
    """So that a diff shows what is new."""
    for language in translations.languages():
        content = json.loads((Path(translations.__file__).parent / f"{language}.json").read_text("utf-8"))
        assert all(list(texts) == sorted(texts) for texts in content.values())


def test_what_panels_put_together_is_german(draw_panels, catalogue, in_german, tmp_path, random_set):
    random_set.save(tmp_path / "fused.ply")
    settings = bpy.context.scene.insideout
    settings.run = str(tmp_path)
    bpy.ops.insideout.import_run()
    bpy.ops.insideout.section_add()
    bpy.ops.insideout.weigh(calibration="POINTS")
    settings.pixels = 64
    bpy.ops.insideout.probe(point=(1, 2, 3))
    bpy.ops.insideout.thickness()
    (tmp_path / "fused.ply").unlink()
    texts = draw_panels(5000)
    assert {"200 Splats", "fused.ply fehlt"} <= set(texts)
    assert any(text.startswith("Mindestens ") for text in texts)
    assert any(text.startswith("Dichte ") and text.endswith("mm⁻¹") for text in texts)
    # The others are looked up by Blender, as they are.
    english = [_filled_in(text) for _, text in catalogue if "{" in text and re.search("[a-z]{3}", text)]
    others = {text for _, text in catalogue}
    assert [text for text in texts if text not in others and any(form.fullmatch(text) for form in english)] == []


def _filled_in(template):
    """Matches what a template can become."""
    parts = string.Formatter().parse(template)
    return re.compile("".join(re.escape(literal) + (".+" if name is not None else "") for literal, name, _, _ in parts))


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("peel_mm", 1.0, "ist nur aus Fotos, die kein Inneres zeigen"),
        ("color_by", "DENSITY", "ist nur aus Fotos, die kein Inneres zeigen"),
        ("color_by", "RESIDUAL", "ist nur aus Fotos, also kann keine Projektion abweichen"),
    ],
)
def test_why_a_model_of_photos_does_not_look_as_asked_is_german(draw_panels, in_german, photo_run, name, value, words):
    settings = bpy.context.scene.insideout
    settings.run = str(photo_run)
    bpy.ops.insideout.import_run()
    setattr(settings, name, value)
    assert words in settings.look_problem
    assert any(words in text for text in draw_panels(50000))


def test_why_a_model_of_projections_does_not_look_as_asked_is_german(blender, in_german, tmp_path, random_set):
    random_set.save(tmp_path / "fused.ply")
    bpy.ops.insideout.import_run(filepath=str(tmp_path / "fused.ply"))
    bpy.context.scene.insideout.color_by = "RESIDUAL"
    assert "hat keine Abweichungen, zu denen es Projektionen braucht" in bpy.context.scene.insideout.look_problem


def test_reports_are_in_german(blender, in_german, tmp_path, random_set, capsys):
    random_set.save(tmp_path / "fused.ply")
    bpy.ops.insideout.import_run(filepath=str(tmp_path / "fused.ply"))
    assert "200 Splats aus fused.ply" in capsys.readouterr().out


_ERRORS = {
    "a folder": (
        lambda folder: bpy.ops.insideout.export_file(filepath=str(folder)),
        "{folder}: ist ein Ordner; der Datei einen Namen geben.",
    ),
    "a long name": (
        lambda folder: bpy.ops.insideout.export_file(filepath=str(folder / f"{300 * 'a'}.ply")),
        f"{{folder}}/{300 * 'a'}.ply: der Dateiname ist zu lang; eine andere Datei oder einen anderen Ordner wählen.",
    ),
    "an empty folder": (
        lambda folder: bpy.ops.insideout.relink(filepath=str(folder)),
        "{folder}: fused.ply ist nicht darin; den Ordner des Laufs wählen, oder die Datei, aus der run fused ist.",
    ),
    "another model": (
        lambda folder: bpy.ops.insideout.relink(filepath=str(folder.parent / "photos run")),
        "{folder.parent}/photos run/fused.ply: enthält ein anderes Modell als run fused: 1,300 Splats, nicht 200; die "
        "richtige Datei wählen.",
    ),
    "no mesh": (
        lambda folder: bpy.ops.insideout.break_model(),
        "{folder.parent}/run/mesh.glb: ist nicht da; den Lauf zu Ende bringen, oder das Modell neu verknüpfen, wenn "
        "der Lauf verschoben wurde.",
    ),
    "no place": (
        lambda folder: bpy.ops.insideout.probe(point=(float("nan"), 0, 0)),
        "(nan, 0.0, 0.0) ist kein Ort, der sich untersuchen lässt; drei Zahlen in mm angeben.",
    ),
}


@pytest.mark.parametrize("error", _ERRORS)
def test_errors_are_german(blender, in_german, photo_run, random_set, tmp_path, error):
    press, sentence = _ERRORS[error]
    random_set.save(tmp_path / "run" / "fused.ply")
    (tmp_path / "empty").mkdir()
    bpy.context.scene.insideout.run = str(tmp_path / "run")
    bpy.ops.insideout.import_run()
    with pytest.raises(RuntimeError) as told:
        press(tmp_path / "empty")
    assert str(told.value).strip() == "Error: " + sentence.format(folder=tmp_path / "empty")


def test_an_error_is_english_until_it_is_shown(in_german, random_set):
    """So that scripts and logs have the same sentence everywhere; and modules without bpy, and threads, make errors."""
    with pytest.raises(SettingError) as made:
        choose_seeds(random_set, 1, 0)
    assert str(made.value) == "1 pieces are no break; choose two or more."
    assert error_text(made.value) == "1 Bruchstücke sind kein Bruch; zwei oder mehr wählen."


def test_errors_of_the_core_are_german(blender, in_german, tmp_path):
    (tmp_path / "a {model}.ply").write_bytes(b"no splats")
    with pytest.raises(
        RuntimeError, match=r"a \{model\}\.ply: ist keine \.ply-Datei; eine \.ply mit Gauß-Splats wählen\."
    ):
        bpy.ops.insideout.import_file(filepath=str(tmp_path / "a {model}.ply"))


def test_errors_of_a_capture_are_german(in_german, tmp_path):
    (tmp_path / "{volume}.npz").write_bytes(b"")
    with pytest.raises(CaptureError) as told:
        read_volume(tmp_path / "{volume}.npz")
    german = f"{tmp_path}/{{volume}}.npz: ist beschädigt: lässt sich nicht als .npz lesen ("
    assert error_text(told.value).startswith(german)
    assert error_text(told.value).endswith("); noch einmal speichern.")


def test_names_are_not_translated(in_german):
    """Nor are braces in them places for values."""
    error = SettingError("{model} was not weighed yet; press Weigh first.", model="Water {name}")
    assert str(error) == "Water {name} was not weighed yet; press Weigh first."
    assert error_text(error) == "Water {name} wurde noch nicht gewogen; zuerst auf „Wiegen“ drücken."


@pytest.mark.parametrize(
    ("code", "words"),
    [
        ("sys.exit(7)", "Die Engine endete unerwartet (Exit-Code 7) und hinterließ keine Meldung. Das ganze Protokoll"),
        ("sys.exit('no GPU')", "Die Engine endete unerwartet (Exit-Code 1): no GPU. Das ganze Protokoll ist in "),
    ],
)
def test_that_the_engine_ended_is_german_and_its_last_words_are_not(blender, in_german, code, words):
    command = [sys.executable, "-c", f"import sys; {code}"]
    last = job.start_job(command, "Trial", lambda message: None, lambda last: None)
    assert job.error_of(last).startswith(words)
    assert bpy.context.window_manager.insideout.error == job.error_of(last)


_FREE = "{folder}: only {free:.0f} MB are free on its disk and a run needs {least:.0f} MB or more; free some space or "
_FREE += "choose another run folder."


@pytest.mark.parametrize(
    ("told", "words"),
    [
        (
            DiskFullError(_FREE, folder=Path("a {b}"), free=np.float32(12.3), least=200).told(),
            "a {b}: nur 12 MB sind auf diesem Laufwerk frei, und ein Lauf braucht 200 MB oder mehr; Platz schaffen "
            "oder einen anderen Ordner des Laufs wählen.",
        ),
        (
            CaptureError("the projections have different pixel sizes; resample them to one first.").told(),
            "die Projektionen haben verschiedene Pixelgrößen; sie zuerst auf eine umrechnen.",
        ),
        # An engine of before has none; one of another version may have others, under the same name too.
        ({}, "In English."),
        ({"template": _FREE, "values": {"folder": "a"}}, "In English."),
        ({"template": _FREE, "values": {"folder": "a", "free": None, "least": 200}}, "In English."),
        ({"template": "{folder.name}", "values": {"folder": "a"}}, "In English."),
        ({"template": None, "values": {}}, "In English."),
        ({"template": "{file}: is of tomorrow.", "values": {"file": "a"}}, "a: is of tomorrow."),
    ],
)
def test_errors_of_the_engine_are_german_where_they_can_be(blender, in_german, told, words):
    line = json.dumps({"type": "error", "kind": "CaptureError", "message": "In English.", "told": told})
    command = [sys.executable, "-c", f"print({line!r})"]
    last = job.start_job(command, "Trial", lambda message: None, lambda last: None)
    assert job.error_of(last) == bpy.context.window_manager.insideout.error == words


def test_what_a_check_finds_is_german(draw_panels, in_german, make_engine, tmp_path):
    """With its numbers, in files too that were saved and opened again; what an engine of before finds is English."""
    names = name_some([f"{number}.tif" for number in range(8)])
    advice = "check its voxel size and position"
    few = warning("xray", "{count} images have no known camera and are not used: {names}", advice, count=8, names=names)
    found = [
        {**vars(few), "told": {"message": few.message.to_json(), "advice": few.advice.to_json()}},
        {"level": "warning", "subject": "xray", "message": "few angles", "advice": "scan more"},
    ]
    make_engine(f"for finding in {found!r}:\n    send('finding', **finding)\nsend('done', errors=0)\n")
    settings = bpy.context.scene.insideout
    settings.capture = str(tmp_path)
    bpy.ops.insideout.check()
    told = [
        "8 Bilder haben keine bekannte Kamera und werden nicht verwendet: 0.tif, 1.tif, 2.tif, 3.tif, 4.tif und 3 "
        "weitere",
        "Voxelgröße und Lage prüfen",
        "few angles",
        "scan more",
    ]
    assert [text for text in draw_panels(50000) if text in told] == told
    for finding in settings.findings:
        # As a file of before has it.
        finding.told = ""
    assert few.message in draw_panels(50000)


_LENS = Told(
    "{told}; less than {least:g} px does no harm.",
    told=Told("The lens moves a photo's corner by {px:.2f} px, give or take {error:.2f} px", px=0.123, error=0.04),
    least=0.5,
)
_GERMAN = (
    "Das Objektiv verschiebt die Ecke eines Fotos um 0.12 px, auf 0.04 px genau; weniger als 0.5 px schadet nicht."
)


@pytest.mark.parametrize(
    ("told", "shown"),
    [
        ({"told": [_LENS.to_json()]}, _GERMAN),
        (
            {"told": [_LENS.to_json(), Told("It is used because you asked for it.").to_json()]},
            f"{_GERMAN} Es wird verwendet, weil es verlangt wurde.",
        ),
        (
            {"told": [Told("It is not used: {other} is, and not both can be.", other=TOLD["defocus"]).to_json()]},
            "Es wird nicht verwendet, denn Unschärfe wird verwendet, und beides zusammen geht nicht.",
        ),
        # Runs of before have the sentence alone; what is damaged is as if it were not there.
        ({}, "In English."),
        ({"told": []}, "In English."),
        ({"told": [{"template": _LENS.template, "values": {"told": "So"}}]}, "In English."),
        ({"told": [_LENS.template]}, "In English."),
        ({"told": 3}, "In English."),
        ({"told": [{"template": "Of tomorrow, by {px:.1f} px.", "values": {"px": 2}}]}, "Of tomorrow, by 2.0 px."),
    ],
)
def test_what_a_run_found_of_an_effect_is_german_where_it_can_be(
    draw_panels, in_german, tmp_path, random_set, told, shown
):
    random_set.save(tmp_path / "fused.ply")
    row = {"name": "lens", "half": "photos", "found": False, "used": False, "reason": "In English.", **told}
    (tmp_path / "report.json").write_text(json.dumps({"stages": {}, "effects": [row]}), "utf-8")
    bpy.ops.insideout.import_file(filepath=str(tmp_path / "fused.ply"))
    assert shown in draw_panels(50000)


def test_what_the_models_run_warned_of_is_german(draw_panels, in_german, tmp_path, random_set):
    """A run of before, or a model in a file of before, has its warnings in English."""
    random_set.save(tmp_path / "fused.ply")
    unit = Told(
        "has gray values without a unit; {high:g} was taken for {attenuation} mm⁻¹, so {relative}",
        high=900,
        attenuation=0.05,
        relative=RELATIVE,
    )
    warning = Told("{subject}: {message}", subject="volume.tif", message=unit)
    report = {"stages": {}, "warnings": [warning], "warnings_told": [warning.to_json()]}
    german = "volume.tif: hat Grauwerte ohne Einheit; 900 wurde als 0.05 mm⁻¹ genommen, also: Dichten sind relativ"
    (tmp_path / "report.json").write_text(json.dumps(report), "utf-8")
    bpy.ops.insideout.import_file(filepath=str(tmp_path / "fused.ply"))
    model = bpy.context.scene.insideout.model
    assert densities_are_relative(model)
    assert german in draw_panels(50000)
    for damaged in ("", "no JSON", "[]", "3", 3):
        model["insideout_warnings_told"] = damaged
        assert warnings_of(model) == [warning]
    del model["insideout_warnings_told"]
    assert warning in draw_panels(50000)


def test_why_an_optimization_ended_is_german(in_german):
    histories = {"surface": {"rgb": {"iterations": 50, "losses": [], "ended": "its time was up"}}}
    histories |= {"internal": {"rgb": {"iterations": 9, "losses": [], "ended": "32 dB of photos: out of reach"}}}
    _, broken = endings(histories, SimpleNamespace(kind="photos", psnr=32.0), 100.0, 50.0)
    assert [told_text(one.to_json(), one) for one in broken] == [
        "--until 32dB: keine Fotos sind zurückbehalten, die sagen könnten, ob es erreicht ist; alle Schritte werden "
        "gemacht",
        "surface rgb: endete nach 50 Schritten, seine Zeit war um",
        "internal rgb: endete nach 9 Schritten, 32 dB (Fotos): nicht zu erreichen",
        "--time-budget 50s: der Lauf dauerte 100 s; ihm mehr Zeit geben",
    ]


def test_what_the_engine_says_of_its_work_is_german(draw_panels, in_german, make_engine, capsys):
    """Where it is, what it is doing, and why a stage was left out; of an engine of before as it said it."""
    doing, why = Told("FDK from {count} projections", count=3), Told("there is no volume to take sections from")
    engine = make_engine(
        f"send('progress', stage='initialize', part='hull', message='{doing}', told={doing.to_json()!r})\n"
        # Only the newest of what comes at once is shown.
        "time.sleep(0.5)\n"
        f"send('stage', stage='internal', state='skipped', reason='{why}', told={why.to_json()!r})\n"
        "send('progress', stage='surface', part='of_tomorrow', fraction=0.25, message='working')\n"
        "time.sleep(0.5)\n"
        "send('stage', stage='align', state='skipped', reason='there is nothing to do')\n"
        "send('cancelled')\n"
    )
    said, state = [], bpy.context.window_manager.insideout
    job.start_job([str(engine), "-m", "worker"], "Trial", lambda _: said.append(state.message), lambda _: None)
    assert said[:2] == ["FDK aus 3 Projektionen", "working"]
    printed = capsys.readouterr().out
    assert "Beginnen Hülle (1 von 5)  0 %" in printed
    assert "Oberfläche of tomorrow (2 von 5)  25 %" in printed
    texts = draw_panels(50000)
    assert [text for text in texts if text in ("es gibt kein Volumen, aus dem Schnitte zu nehmen wären", str(why))] == [
        "es gibt kein Volumen, aus dem Schnitte zu nehmen wären"
    ]
    assert "there is nothing to do" in texts


def test_why_there_is_no_engine_is_german(draw_panels, in_german, monkeypatch):
    monkeypatch.setenv("INSIDEOUT_ENGINE", "/nowhere/python")
    forget()
    assert any(
        "/nowhere/python: INSIDEOUT_ENGINE ist nicht da; das Programm python einer Umgebung" in text
        for text in draw_panels(50000)
    )


@pytest.mark.skipif(not _PROGRAM, reason="needs a Blender program: languages are not in bpy's wheels")
def test_blender_speaks_german(tmp_path):
    """In a Blender of its own with languages, see translated_session.py."""
    script = _HERE / "translated_session.py"
    answer = subprocess.run(
        [_PROGRAM, "--background", "--factory-startup", "--python-exit-code", "1", "--python", str(script)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert answer.returncode == 0, answer.stdout + answer.stderr
    found = json.loads(next(line for line in answer.stdout.splitlines() if line.startswith("found:"))[6:])
    assert found["en_US"] == {
        "panel": "Weigh",
        "button": "Add Section Plane",
        "label": "Import a model first, under Model",
        "error": f"Error: {_HERE.parents[1]}: is a folder; give the file a name.",
    }
    assert found["de_DE"] == {
        "panel": "Wiegen",
        "button": "Schnittebene hinzufügen",
        "label": "Zuerst unter „Modell“ ein Modell importieren",
        "error": f"Fehler: {_HERE.parents[1]}: ist ein Ordner; der Datei einen Namen geben.",
    }
    assert found["disabled"].items() < found["en_US"].items()
