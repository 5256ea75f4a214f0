import torch
from baselines import plain_uplift
from small_task import task

from kfgs._rows import unit_rows
from kfgs.cameras import resize_map
from kfgs.splat import average_views


def test_it_is_the_mean_by_rendering_weight():
    one = task()
    found = plain_uplift.fit(one, plain_uplift.PlainUpliftConfig(keep=1.0))
    maps = [resize_map(unit_rows(map), camera.size) for map, camera in zip(one.maps, one.cameras, strict=True)]
    wanted = average_views(one.geometry, zip(one.cameras, maps, strict=True)).values
    decoded = found.tensors["features"] @ found.tensors["basis"].T
    cosines = (unit_rows(decoded) * unit_rows(wanted)).sum(1)
    assert float(cosines[wanted.any(dim=1)].min()) > 0.99
    assert torch.equal(decoded.any(dim=1), wanted.any(dim=1))
