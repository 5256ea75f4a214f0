import pytest

from kfgs.scenes import file_stem


@pytest.mark.parametrize(
    ("name", "stem"), [("a.png", "a"), ("train/r_0.png", "train/r_0"), ("a", "a"), ("/", "/"), (".", "."), ("", "")]
)
def test_file_stem(name: str, stem: str) -> None:
    assert file_stem(name) == stem
