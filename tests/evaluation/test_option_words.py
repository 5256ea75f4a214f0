import pytest

from kfgs.evaluation.option_words import parse_options


@pytest.mark.parametrize(
    ("protocol", "word", "value"),
    [
        ("lerf-ovs-2d", "level=oracle", "oracle"),
        ("lerf-ovs-2d", "level=2", 2),
        ("lerf-ovs-2d", "threshold=0.5", 0.5),
        ("lerf-ovs-2d", "negatives=object, stuff", ("object", "stuff")),
        ("3dovs-threshold", "stretched=no", False),
        ("3dovs-stability", "fractions=0.01,0.8", (0.01, 0.8)),
        ("feature3dgs-teacher", "split=none", None),
        ("feature3dgs-teacher", "split=4,1", (4, 1)),
        ("feature3dgs-teacher", "texts=full", "full"),
        ("feature3dgs-teacher", "texts=wall,coffee table", ("wall", "coffee table")),
        ("feature3dgs-teacher", "texts=wall", ("wall",)),
        ("feature3dgs-teacher", "merged=[[90, 15], [29, 4]]", ((90, 15), (29, 4))),
        ("scenesplat-fmiou", "least_cosine=0.2", 0.2),
        ("scenesplat-fmiou", "template=a photo of a {}", "a photo of a {}"),
        ("scannet-points", "unknown=first class", "first class"),
    ],
)
def test_words_become_the_options_types(protocol, word, value):
    assert parse_options(protocol, [word]) == {word.partition("=")[0]: value}


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("threshold=high", "expected threshold as a number, got 'high'"),
        ("level=best", "expected level as chosen or oracle or a whole number, got 'best'"),
        ("filter=none", "expected filter as langsplat or langsplatv2"),
        ("treshold=1", "did you mean threshold"),
        ("threshold", "expected name=value"),
    ],
)
def test_words_that_do_not_fit(word, message):
    with pytest.raises(ValueError, match=message):
        parse_options("lerf-ovs-2d", [word])


def test_numbers_that_are_none_and_pairs_of_three():
    with pytest.raises(ValueError, match="expected split as whole numbers between commas or none"):
        parse_options("feature3dgs-teacher", ["split=1,2,3"])
    for word in ("merged=5", "merged={}", "merged=[5]", "merged=[[1, 2, 3]]", "merged=[[1"):
        with pytest.raises(ValueError, match="expected merged as a JSON list of pairs"):
            parse_options("feature3dgs-teacher", [word])
    with pytest.raises(ValueError, match="expected stretched as true or false"):
        parse_options("3dovs-threshold", ["stretched=maybe"])


def test_inputs_stay_text():
    assert parse_options("kfgs-removal", ["removed=chair"], ["before", "removed"]) == {"removed": "chair"}
