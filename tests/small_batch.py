"""Small rooms for batches, what one process makes of a room, and the comparison of two runs."""

import dataclasses
import json
from pathlib import Path

from cases_training import changed
from small_room import ROOM
from tiny_teacher import Tiny

from kfgs.batch import BatchOptions
from kfgs.fields import SemanticField
from kfgs.labels import load_label_set
from kfgs.pipeline import ColorConfig, Uplift, fit, score_scene, segment_scene, true_labels
from kfgs.scenes import FeatureFolder, extract_features, load_scene
from kfgs.toy.room_folder import make_toy_room

COLOR = dataclasses.replace(
    ColorConfig.quick(), training=changed(ColorConfig.quick().training.with_steps(24), maximum=800, checkpoint_every=8)
)
METHOD = Uplift(color=COLOR)
OPTIONS = BatchOptions(teacher="tiny_teacher:Tiny", method=METHOD, pictures=0)
TIMES = ("seconds", "mtime_ns", "command", "machine", "history.json")  # the last: its size, in a list of files
NOT_RESULTS = ("log.txt", "state.json", "digests.json", "done/")


def make_rooms(folder: Path, count: int) -> list[Path]:
    rooms = [dataclasses.replace(ROOM, seed=seed, train_views=5, test_views=1) for seed in range(count)]
    return [make_toy_room(folder / f"room{room.seed}", room) for room in rooms]


def one_process(room: Path, out: Path) -> Path:
    """The stages one after the other, as a person calls them."""
    scene = load_scene(room)
    extract_features(Tiny(), scene, out / "features")
    fit(scene.undistorted(), FeatureFolder(out / "features").of(scene), METHOD, folder=out)
    classes = load_label_set(room / "classes.json", room / "text.npy")
    truth = true_labels(scene, room / "labels", "test")
    field = SemanticField.load(out / "field.kfgs")
    labels = segment_scene(field, scene, classes, out / "segmented", pictures=0, truth=truth)
    report = score_scene(labels, truth, classes)
    (out / "scores.json").write_text(json.dumps({"scene": room.name, **report.to_json()}, indent=2) + "\n")
    return out


def results(run: Path) -> dict[str, bytes]:
    """All files of a run by name, JSON without times."""
    found = {}
    for file in sorted(run.rglob("*")):
        name = file.relative_to(run).as_posix()
        if not file.is_file() or name.startswith(NOT_RESULTS) or any(part.startswith(".") for part in name.split("/")):
            continue
        if name == "field.kfgs":  # whose notes say how long it took
            cloud = SemanticField.load(file).gaussians
            found[name] = b"".join(values.numpy().tobytes() for values in (cloud.means, cloud.scales, cloud.features))
        else:
            found[name] = timeless(file.read_bytes()) if file.suffix == ".json" else file.read_bytes()
    return found


def timeless(text: bytes) -> bytes:
    """JSON without times; with the order of its entries."""

    def without(value):
        if isinstance(value, dict):
            return {name: without(one) for name, one in value.items() if name not in TIMES}
        return [without(one) for one in value] if isinstance(value, list) else value

    return json.dumps(without(json.loads(text))).encode()
