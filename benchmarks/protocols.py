"""Score results under a protocol, also those that papers published, and results of other programs; compare several.

    python benchmarks/protocols.py RUN --scene lerf_ovs/figurines --protocol lerf-ovs-2d --teacher openclip --weights HUB_ID
    python benchmarks/protocols.py output/figurines=best_ckpt.pth --scene lerf_ovs/figurines --protocol lerf-ovs-2d --teacher ...
    python benchmarks/protocols.py RUN_A RUN_B output/room_0 --scene room_0 --out compared/ --pictures 5
    python benchmarks/protocols.py RUN --scene figurines --protocol lerf-ovs-3d --set selection=smoothed --set threshold=0.6

A result is a field or run of kfgs, a folder of a teacher's maps, or what another program wrote (RESULT=FILE names its second
file: LangSplat's autoencoder, LEGaussians' codebook, Feature 3DGS's decoder, features of a splat). All are asked the same
question. --out receives scores.json, and for several results a picture of each view: photograph, truth, results, errors.
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from pathlib import Path
from typing import Any

from published import PROTOCOLS
from published.foreign import load_foreign
from published.side_by_side import table_text, write_pictures

from kfgs import load_label_set
from kfgs._files import write_json
from kfgs.evaluation import Report, get_protocol
from kfgs.evaluation.teacher_agreement import TeacherAgreement
from kfgs.evaluation.texts import as_encoder
from kfgs.pipeline import evaluate, open_question
from kfgs.pipeline.evaluate import Question, open_result
from kfgs.teachers import load_teacher


def main() -> None:
    """Score each result, print the reports or a table, and write what --out asks for."""
    args = parse_arguments()
    encode = find_encoder(args)
    options = parse_options(args.set)
    if options.get("texts") == "classes":
        options["texts"] = encode.names
    protocol = get_protocol(args.protocol, PROTOCOLS, **options)
    question = open_question(args.scene, protocol, truth=args.truth, split=args.split, images=args.images)
    if isinstance(protocol, TeacherAgreement) and protocol.texts is None and hasattr(encode, "names"):
        question = question._replace(protocol=get_protocol(args.protocol, PROTOCOLS, **options, texts=encode.names))
    methods = {result: open_any(result, question) for result in args.results}
    reports: dict[str, Report] = {}
    for result, method in methods.items():
        command = shlex.join(["python", *sys.argv])
        reports[result] = evaluate(method, question, encode=encode, labels=args.labels, command=command)
        print(f"{result}: {reports[result].text if args.long else reports[result]}")
        print("\n".join(f"  note: {note}" for note in reports[result].notes if not args.long))
    if len(reports) > 1:
        print(table_text(reports))
    if args.out is not None:
        write_json(args.out / "scores.json", {result: report.to_json() for result, report in reports.items()})
        if len(reports) > 1:
            write_pictures(args.out, question, methods, None if encode is None else as_encoder(encode), args.pictures)
        print(f"wrote {args.out}")


def open_any(result: str, question: Question) -> Any:
    """A result of kfgs, or of another program: PATH, or PATH=SECOND_FILE."""
    path, _, second = result.partition("=")
    if second:
        return load_foreign(path, second)
    try:
        return open_result(path, question)
    except ValueError as error:
        if "other programs" not in str(error):
            raise
        return load_foreign(path)


def parse_options(words: list[str]) -> dict[str, Any]:
    """NAME=VALUE of --set: JSON (0.5, true, null, ["wall", "floor"]), or a text."""
    options = {}
    for word in words:
        name, equals, value = word.partition("=")
        if not equals:
            sys.exit(f"--set: expected NAME=VALUE, got {word}")
        try:
            parsed = json.loads(value)
        except ValueError:
            parsed = value
        options[name] = tuple(parsed) if isinstance(parsed, list) else parsed
    return options


def find_encoder(args: argparse.Namespace) -> Any:
    """The teacher's text encoder, or a label set; None if neither is known."""
    if args.teacher is not None:
        return load_teacher(args.teacher, args.weights).encode_text
    if args.text is not None:
        return load_label_set(*args.text)
    files = args.scene / "classes.json", args.scene / "text.npy"
    return load_label_set(*files) if all(file.is_file() for file in files) else None


def parse_arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", nargs="+", help="RESULT, or RESULT=SECOND_FILE")
    parser.add_argument("--scene", type=Path, required=True)
    parser.add_argument("--protocol", default="kfgs-pooled/1", help=f"one of {', '.join(PROTOCOLS)}")
    parser.add_argument("--set", action="append", default=[], help="an option of the protocol, threshold=0.5")
    parser.add_argument("--truth", type=Path, help="folder or file of the ground truth, if it is not in the scene")
    parser.add_argument("--split", help="train, test, another split, or all")
    parser.add_argument("--images", type=Path, help="folder of the scene's pictures")
    parser.add_argument("--labels", choices=("own", "nearest"), help="who says the class of a pixel in a field of kfgs")
    parser.add_argument("--teacher", help="its text encoder embeds the texts")
    parser.add_argument("--weights", help="the teacher's")
    parser.add_argument("--text", type=Path, nargs="+", help="table.safetensors, or classes.json and text.npy")
    parser.add_argument("--out", type=Path, help="folder for scores.json and pictures")
    parser.add_argument(
        "--pictures", type=int, default=3, help="how many views are drawn, if there are several results"
    )
    parser.add_argument("--long", action="store_true", help="say how it was measured, and print every row")
    return parser.parse_args()


if __name__ == "__main__":
    main()
