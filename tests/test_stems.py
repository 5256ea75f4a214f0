"""One rule for names of pictures."""

import pytest

from kfgs._files import Names


@pytest.mark.parametrize(
    ("asked", "there", "meant"),
    [
        ("A.JPG", ["A.jpg", "B.jpg"], "A.jpg"),
        ("a.jpg", ["A.jpg", "B.jpg"], "A.jpg"),
        ("A.JPG", ["A.png"], "A.png"),
        ("A.heic", ["A.jpg", "B.jpg"], "A.jpg"),
        ("A", ["A.jpg", "AB.jpg"], "A.jpg"),
        ("A.jpg", ["A.jpg.png"], "A.jpg.png"),  # a mask of COLMAP
        ("left\\a.png", ["left/a.png", "right/a.png"], "left/a.png"),
        ("K\u00fcche/1.png", ["Ku\u0308che/1.png"], "Ku\u0308che/1.png"),
        ("Ku\u0308che.png", ["k\u00fcche.PNG"], "k\u00fcche.PNG"),
        ("./images/a.png", ["a.png"], "a.png"),
        ("C:\\me\\images\\a.png", ["images/a.png", "b/a.png"], "images/a.png"),
        ("shot.5", ["shot.5.png", "shot.6.png"], "shot.5.png"),
        ("a.png", ["A.png", "A.PNG"], None),  # not clear which
        ("A.jpg", ["A.png", "A.tif"], None),
        ("shot.5", ["shot.png"], None),  # .5 is no ending
        ("a.png", ["masks/a.png"], None),  # of another folder
        ("left/a.png", ["right/a.png"], None),
        ("", ["a.png"], None),
    ],
)
def test_a_name_is_found_as_it_was_respelled(asked: str, there: list[str], meant: str | None) -> None:
    assert Names(there).find(asked) == meant


def test_the_exact_name_wins_over_one_that_differs_in_case() -> None:
    names = Names(["a.png", "A.png", "a.jpg"])
    assert [names.find(name) for name in ("a.png", "A.png", "a.jpg", "A.jpg")] == ["a.png", "A.png", "a.jpg", "a.jpg"]


def test_names_of_views_may_lack_their_folder_where_only_one_fits() -> None:
    names = Names(["left/a.png", "right/a.png", "left/b.png"], bare=True)
    assert [names.find(name) for name in ("b.png", "b", "a.png", "left/a")] == [
        "left/b.png",
        "left/b.png",
        None,
        "left/a.png",
    ]


def test_a_name_with_a_folder_is_not_that_of_another_folder() -> None:
    names = Names(["left/a.png"], bare=True)
    assert [names.find(name) for name in ("a.png", "images/left/a.png", "right/a.png")] == ["left/a.png"] * 2 + [None]


def test_what_several_find_is_only_for_one_that_is_spelled_so() -> None:
    assert Names(["a.png", "b.png"]).find_each(["left/a.png", "right/a.png", "left/b.jpg"]) == [None, None, "b.png"]
    assert Names(["a.png"]).find_each(["a.png", "right/a.png"]) == ["a.png", None]


def test_the_nearest_name_is_the_advice() -> None:
    assert Names(["rgb_1.png", "rgb_12.png", "depth.png"]).advice("DETH") == "did you mean 'depth.png'?"
    assert Names([]).advice("a") == "there are no names to choose from"
