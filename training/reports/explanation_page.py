"""The files of an explanation: a self-contained page, its pictures and JSON."""

import base64
import collections
import itertools
import json
import re
from pathlib import Path

from thor2_jax import Explanation, InputError, Recognition, RGBDFrame
from thor2_jax.explanation.pictures import change_text, loss_text, pictures
from thor2_jax.figures import save_figure
from thor2_jax.files import atomic_directory, has_json, remove_written, write_text
from training.reports.html import Picture, Section, Table, write_page

__all__ = ["PAGE", "check_no_foreign_files", "write_explanation"]

PAGE = "explanation.html"
VALUES = "explanation.json"

_PICTURES = "photo|cloud|slices-attributions|check|surfaces|changes|nearest|slices|diagrams|slice-[0-9]+|network"
_WRITTEN = rf"{re.escape(PAGE)}|{re.escape(VALUES)}|({_PICTURES})\.png"

_SOURCES = {
    "tops": "shape (TOPS)",
    "tops2": "shape and colour (TOPS2)",
    "ce": "colour (CE)",
    "embedding": "shape and colour (embedding)",
    "gallery": "gallery",
}

_SURFACES = (
    "Recognition also compares the points with the surfaces of the most probable objects, in the pose that fits best. "
    "This changes their probabilities, and decides whether the object is known. The distance is that of the points "
    "from the surface, on average, divided by the roughness of the points, with 8 % of the size of the instance added "
    "to both: about 1 is a perfect fit. Chroma and lightness are correlations between the colours of the points and "
    "those of the surface: 1 is a perfect fit. The part of the surface in free space would lie in front of what the "
    "camera sees: 0 % is a perfect fit."
)

_SHAPE = (
    "THOR2 rotates each object into a normalized pose and cuts it into slices and each slice into strips. It measures "
    "the width of every strip (the persistence diagrams and images) and its colours (the colour matrices)."
)

_SLICES = (
    "A persistence image shows each strip of a slice as a spot: the horizontal axis is the position of the strip "
    "(birth), the vertical axis is the width of the object there (persistence). A colour matrix shows the same strips "
    "from left to right. Each row shows the points of one colour region in its mean colour; full colour means many "
    "points."
)


def check_no_foreign_files(directory: Path) -> None:
    """Raise InputError if `write_explanation` would replace files that are not from an older explanation."""
    names = sorted(path.name for path in directory.glob("*") if re.fullmatch(_WRITTEN, path.name))
    if names and not has_json(directory / VALUES, ("label", "explained_name", "faithfulness")):
        raise InputError(
            f"out: {directory} has {names[0]}, which this command has not written; choose another directory"
        )


def write_explanation(explanation: Explanation, frame: RGBDFrame, name: str, directory: Path) -> None:
    """Write an explanation to a directory, all files or none; an older explanation is replaced.

    Args:
        explanation: the explanation.
        frame: the explained frame.
        name: name of the frame.
        directory: output directory; other files in it are kept.

    Raises:
        OSError: a file cannot be written; no files are left behind.
    """
    with atomic_directory(directory) as unfinished:
        sections = collections.defaultdict[str, list[Picture]](list)
        for picture in pictures(explanation, frame):
            file = unfinished / f"{picture.name}.png"
            save_figure(picture.figure, file)
            content = f"data:image/png;base64,{base64.b64encode(file.read_bytes()).decode()}"
            shown = Picture(content, picture.caption, "third" if picture.section == "slices" else "half")
            sections[picture.section].append(shown)
        write_text(unfinished / VALUES, json.dumps(explanation.as_json()) + "\n")
        title, lead = f"Why {explanation.title}?", _lead(explanation, name)
        write_page(unfinished / PAGE, title=title, lead=lead, sections=_page_sections(explanation, sections))
        remove_written(directory, _WRITTEN)


def _lead(explanation: Explanation, name: str) -> str:
    answer = explanation.recognition
    sure = "" if answer.confidence is None else f" with a confidence of {100 * answer.confidence:.0f} %"
    what = f"is recognized as {answer.name}{sure}"
    if answer.name is None:
        what = f"gets no name ({answer.reason}); the most probable name is {explanation.name}"
    occluded = " It is partly occluded." if answer.occluded else ""
    return f"Object {answer.label} in frame {name} {what}.{occluded}"


def _page_sections(explanation: Explanation, pictures: collections.defaultdict[str, list[Picture]]) -> list[Section]:
    check, name = explanation.attributions, explanation.name
    if explanation.scores.unit == "log-odds":
        answer = (
            f"The classifiers' log-odds of {name} are {check.margin:z.1f}. Log-odds compare a class with the others "
            "together, as if the object were one of them: 0 is even, 2.2 means 90 %, 4.6 means 99 %."
        )
    else:
        answer = _similarity_text(name, explanation.runner_up, check.margin)
    answer += " The attributions below explain this number."
    if explanation.runner_up is not None:
        answer += f" The best other name is {explanation.runner_up}."
    decided = (
        "The attribution of a point is approximately how much the answer would lose without it. Without the tenth of "
        f"the points with the highest attributions, the answer {loss_text(explanation, check.most_attributed)}; "
        f"without a random tenth, it {loss_text(explanation, check.random)} on average. Points that are left out "
        "together can matter more, or less, than the sum of their attributions; the exact check shows how large this "
        "difference is for the strips of this object."
    )
    surfaces = [Section("Does it fit the surfaces?", _SURFACES, _surfaces_table(explanation), pictures["surfaces"])]
    resembling = [Section("What it resembles", pictures=pictures["nearest"])] if pictures["nearest"] else []
    return [
        Section("The answer", answer, _answer_table(explanation.recognition)),
        Section("What decided", decided, pictures=pictures["decided"]),
        *(surfaces if explanation.surfaces else []),
        Section("How little would change the answer", _changes_text(explanation), pictures=pictures["changes"]),
        *resembling,
        Section("If the name is wrong", _advice(explanation)),
        Section("What the descriptor sees", _SHAPE, pictures=pictures["shape"]),
        Section("Slice by slice", _SLICES, pictures=pictures["slices"]),
        Section("Its colours", pictures=pictures["network"]),
    ]


def _similarity_text(name: str, other: str | None, lead: float) -> str:
    """Return the lead of a name; it is negative if surfaces decided against the most similar object."""
    if other is None:
        return f"The similarity to {name} (cosine) is {lead:z.2f}, and no other object is enrolled."
    degree = "as similar (in cosine, to within 0.005) as"
    if abs(lead) >= 0.005:
        degree = f"{abs(lead):.2f} {'less' if lead < 0 else 'more'} similar (in cosine) than"
    return f"{name} is {degree} the most similar other enrolled object."


def _advice(explanation: Explanation) -> str:
    answer, other = explanation.recognition, explanation.runner_up
    sentences = [
        "Add this view to the true object; no training is needed: thor2 enroll NAME FRAME --instance "
        f"{answer.label} --model RUN --extend."
    ]
    if other is not None:
        sentences.append(
            f"If {explanation.name} and {other} look alike from this side, add views of both from this side, which "
            "show the difference."
        )
    if any(change.kind == "color" for change in explanation.changes):
        sentences.append(
            "A shift of the colours changes the answer: if the whole frame is warmer or cooler than the training "
            "views, adapt the model to the camera: thor2 adapt FRAME... --model RUN --out RUN2."
        )
    if answer.occluded:
        sentences.append("It is partly occluded: look from another side, and fuse the frames (--track).")
    return " ".join(sentences)


def _changes_text(explanation: Explanation) -> str:
    scores = explanation.scores.of_instances([explanation.instance])[0]
    kinds = {"color": "A shift of all colours", "extent": "A change of the side lengths"}
    sentences = [f"{kinds[c.kind]} ({change_text(c)}) makes {c.answer} most probable." for c in explanation.changes]
    if explanation.scores.names[scores.argmax()] != explanation.name:
        decided = "the surfaces of the objects, or classifiers and gallery together, decided"
        sentences.insert(0, f"The explained scores alone would give {explanation.runner_up}; {decided}.")
    changed = {change.kind for change in explanation.changes}
    if "color" not in changed:
        sentences.append("No shift of the colours by up to half of their range was found to change the name.")
    if "extent" not in changed:
        sentences.append("No change of the side lengths by up to a factor of two was found to change the name.")
    return " ".join(sentences)


def _answer_table(answer: Recognition) -> Table:
    sources = [source for source in _SOURCES if answer.top.get(source)]
    # Names without views in the gallery have a probability of 0.
    columns = [[f"{name} {_percent(value)}" for name, value in answer.top[source] if value] for source in sources]
    ranked = enumerate(itertools.zip_longest(*columns, fillvalue=""), 1)
    return ["", *(_SOURCES[source] for source in sources)], [[str(rank), *cells] for rank, cells in ranked]


def _surfaces_table(explanation: Explanation) -> Table:
    rows = []
    for fit in explanation.surfaces:
        free = f"{100 * fit.free_space:.0f} %"
        rows.append([fit.name, f"{fit.distance:.2f}", f"{fit.chroma:z.2f}", f"{fit.lightness:z.2f}", free])
    return ["", "distance / roughness", "chroma", "lightness", "in free space"], rows


def _percent(value: float) -> str:
    """Return a probability as text, never as 0 % or 100 %."""
    if value > 0.999:
        return ">99.9 %"
    return f"{100 * value:.1f} %" if value >= 0.001 else "<0.1 %"
