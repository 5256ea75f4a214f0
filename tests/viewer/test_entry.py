import pytest
import torch
from cases_explorer import NAMES, cameras, classes, cloud, field, splat_file, stored
from kfgs.viewer.entry import meaning_of
from messages import tells

from kfgs.viewer import ExploreOptions, FieldMeaning, SplatMeaning, explore

SMALL = ExploreOptions(height=120, width=320)


@pytest.mark.usefixtures("driver")
def test_a_stored_field_needs_nothing_else_to_be_looked_at(tmp_path):
    made = stored(tmp_path, cameras=tuple(cameras()))
    with explore(made, where="picture", options=SMALL) as explorer:
        asked = explorer.ask("chair")
        assert torch.equal(asked.selection.mask, made.query("chair").mask)
        assert explorer.state.meaning.names == NAMES
        assert [camera.name for camera in explorer.state.cameras] == ["view_0", "view_1", "view_2"]
        best = int(asked.selection.indices[0])
        assert {sight.name for sight in explorer.state.pick("semantic", best).views} <= {"view_0", "view_1", "view_2"}
        assert len(explorer.state.picked.views) > 0


@pytest.mark.usefixtures("driver")
def test_cameras_that_are_given_tell_who_sees_a_gaussian(tmp_path):
    made = stored(tmp_path, cameras=tuple(cameras()))
    with explore(made, cameras=cameras(1), where="picture", options=SMALL) as explorer:
        assert len(explorer.state.cameras) == 1
        assert torch.equal(explorer.ask("chair").selection.mask, made.query("chair").mask)


def test_who_can_be_asked_what(tmp_path):
    splats = splat_file(cloud([[0.0, 0, 5]], [1]))
    assert isinstance(meaning_of(splats), SplatMeaning)
    assert isinstance(meaning_of(stored(tmp_path)), FieldMeaning)
    with pytest.raises(ValueError, match=tells("classes:", "got one")):
        meaning_of(splats, classes())
    with pytest.raises(ValueError, match=tells("classes:", "got neither")):
        meaning_of(field())
