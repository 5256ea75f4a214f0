# %% [markdown]
# # 7. A lost camera
#
# **Where was this photo taken from?** A splat knows what the room looks like from everywhere, and it can be differentiated. So
# PyTorch can look for the camera: kornia's `Se3` holds the pose, `kfgs.nn.GaussianRenderer` draws what it sees. You will see
# the photo, the wrong start, and what was found; then a field without colours learns them from photos in the same way.
#
# About 20 seconds on two CPU cores (a minute more for the room and its field the first time). Needs the extra `notebook`,
# no data.

# %%
# Your own data: scene = load_scene("my/scene").undistorted(), and a splat and a field that kfgs fit made from it.
from example import make_room, make_run

from kfgs import SemanticField, load_scene, read_splats

run = make_run()
scene = load_scene(make_room()).undistorted()
splat, field = read_splats(run / "color.ply"), SemanticField.load(run / "field.kfgs")
view = scene.views("test")[2]  # a photo that neither of them was made from

# %% [markdown]
# ## The photo, and a wrong pose
#
# The camera becomes a `PinholeCamera` of kornia, the photo a tensor [1, 3, H, W]. The start is 20 cm and 6 degrees away.

# %%
import torch
from kornia.geometry import resize
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.liegroup import Se3
from PIL import Image

from kfgs import viz
from kfgs.cameras import to_bchw, to_kornia
from kfgs.nn import GaussianRenderer

truth = to_kornia(scene[view].resized(72, 96))
photo = resize(to_bchw(scene.image(view)), (72, 96), antialias=True)
start = Se3.exp(torch.tensor([[0.15, -0.1, 0.1, 0.05, 0.08, -0.04]])) * Se3.from_matrix(truth.extrinsics)
start = start.matrix().detach()
renderer = GaussianRenderer(near=scene[view].near)


def camera_at(pose):  # [1, 4, 4] from world to camera
    return PinholeCamera(truth.intrinsics, pose, truth.height, truth.width)


# %% [markdown]
# ## Adam on six numbers
#
# A step of `Se3.exp` turns and moves the camera. The loss is the mean difference of the pictures. Its gradient goes through
# compositing, projection and pose.

# %%
step = torch.zeros(1, 6, requires_grad=True)
adam = torch.optim.Adam([step], lr=0.02)
for _ in range(50):
    pose = (Se3.exp(step) * Se3.from_matrix(start)).matrix()
    loss = (renderer(splat, camera_at(pose)).map - photo).abs().mean()
    adam.zero_grad()
    loss.backward()
    adam.step()
found = pose.detach()


def off(pose):
    away = Se3.from_matrix(pose) * Se3.from_matrix(truth.extrinsics).inverse()
    shift, turn = away.log().detach().split(3, dim=1)
    return f"{100 * shift.norm():.0f} cm, {torch.rad2deg(turn.norm()):.1f} degrees off"


with torch.no_grad():
    pictures = [photo, *(renderer(splat, camera_at(pose)).map for pose in (start, found))]
titles = ["the photo", f"start: {off(start)}", f"found: {off(found)}"]
row = [picture[0].permute(1, 2, 0).clamp(0, 1) for picture in pictures]
Image.fromarray(viz.picture_grid([row], titles, width=240))

# %% [markdown]
# ## Features by `torch.optim`
#
# The semantic field has no colours. Any feature can be given to its Gaussians and trained: here three numbers each, from the
# training photos, four per step. Now only features have a gradient, so that the compiled projection is used.

# %%
views = scene.select("train")
photos = torch.cat([resize(to_bchw(views.image(i)), (72, 96), antialias=True) for i in range(len(views))])
cameras = [camera.resized(72, 96) for camera in views]
colors = torch.full((len(field), 3), 0.5, requires_grad=True)
adam = torch.optim.Adam([colors], lr=0.05)
for step in range(60):
    batch = [(4 * step + i) % len(cameras) for i in range(4)]
    drawn = renderer(field.gaussians.replace(features=colors), [cameras[i] for i in batch]).map
    loss = (drawn - photos[batch]).abs().mean()
    adam.zero_grad()
    loss.backward()
    adam.step()

with torch.no_grad():
    before, after = (field.gaussians.replace(features=rows) for rows in (torch.full_like(colors, 0.5), colors))
    pictures = [photo, *(renderer(cloud, truth).map for cloud in (before, after))]
row = [picture[0].permute(1, 2, 0).clamp(0, 1) for picture in pictures]
Image.fromarray(viz.picture_grid([row], ["the photo", "the field, grey", "with colours that it learnt"], width=240))

# %% [markdown]
# The page *kfgs for users of kornia* of the documentation has more: lenses, codebooks and autoencoders as layers.
