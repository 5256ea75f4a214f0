"""One posed camera: its place, its projection, the size of its picture."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from kornia.geometry.liegroup import Se3
from kornia.geometry.pose import NamedPose
from kornia.image import ImageSize
from kornia.sensors.camera import CameraModel, CameraModelType
from torch import Tensor

from .._card import cut
from .._check import ORIGIN, as_origin, as_tensor, check_choice, check_range, check_shapes
from .._files import Names
from .._origin import to_world

DistortionModel = Literal["brown_conrady", "kannala_brandt"]
COEFFICIENTS = {"brown_conrady": (4, 5, 8), "kannala_brandt": (4,)}

ROTATION_TOLERANCE = 1e-3  # of R R^T: matrices from text files have few digits
NEAR = 0.2  # world units: the smallest depth that 3DGS draws, meant for scenes of metres
UP = (0.0, 0.0, 1.0)  # in the world, by default
_names = functools.lru_cache(8)(functools.partial(Names, bare=True))  # of views: many are looked up one after the other


@dataclass(frozen=True)
class Distortion:
    """Lens distortion in kornia's (= OpenCV's) order of coefficients.

    `brown_conrady`: k1, k2, p1, p2[, k3[, k4, k5, k6]]; `kannala_brandt` (fisheye): k1, k2, k3, k4.
    """

    model: DistortionModel
    coefficients: tuple[float, ...]

    def __post_init__(self) -> None:
        check_choice("model", self.model, COEFFICIENTS)
        if (count := len(self.coefficients)) not in COEFFICIENTS[self.model]:
            expected = f"{' or '.join(map(str, COEFFICIENTS[self.model]))} numbers for {self.model}"
            raise ValueError(f"coefficients: expected {expected}, got {count}; pad with zeros")
        for i, coefficient in enumerate(self.coefficients):
            check_range(f"coefficients[{i}]", coefficient, float("-inf"), closed=(False, False))


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera, with or without lens distortion.

    **Convention** (COLMAP's): `viewmat` maps world to camera, x right, y down, z forward; the centre of the first pixel
    is (0.5, 0.5), so a centred principal point is (width / 2, height / 2). K is in pixels, without skew.
    A camera with distortion must be undistorted (`undistort`) before anything is rasterised through it. Only what is deeper
    than `near` is drawn; `load_scene` chooses it, `Similarity.apply_to_camera` scales it. Arrays and lists are accepted.
    """

    viewmat: Tensor  # [4, 4] world to camera
    K: Tensor  # [3, 3]
    width: int
    height: int
    name: str = ""
    distortion: Distortion | None = None
    near: float = NEAR  # > 0, world units: the smallest depth that is drawn
    origin: tuple[float, float, float] = ORIGIN  # where the (0, 0, 0) that viewmat maps from lies in the world
    size = property(lambda self: (self.height, self.width), doc="(height, width) in pixels.")
    R = property(lambda self: self.viewmat[:3, :3], doc="The rotation from world to camera [3, 3].")
    t = property(lambda self: self.viewmat[:3, 3], doc="The translation from world to camera [3]: x_camera = R x + t.")
    c2w = property(lambda self: torch.linalg.inv(self.viewmat), doc="Camera to world [4, 4], the inverse of `viewmat`.")
    center = property(lambda self: -self.R.T @ self.t, doc="The camera's position [3], counted from `origin`.")
    fx = property(lambda self: float(self.K.detach()[0, 0]), doc="The horizontal focal length, pixels.")
    fy = property(lambda self: float(self.K.detach()[1, 1]), doc="The vertical focal length, pixels.")
    cx = property(lambda self: float(self.K.detach()[0, 2]), doc="The principal point, pixels from the left edge.")
    cy = property(lambda self: float(self.K.detach()[1, 2]), doc="The principal point, pixels from the upper edge.")
    intrinsics_at_integer_centers = property(
        lambda self: self.K - self.K.new_tensor([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]),
        doc="K [3, 3] for functions that put the centre of the first pixel at (0, 0), as kornia's grids do: cx, cy less 0.5.",
    )
    model = property(lambda self: kornia_model(self.K, self.distortion, self.size), doc="Kornia's `CameraModel`.")
    pose = property(lambda self: Se3.from_matrix(self.viewmat.clone()), doc="The viewmat as kornia's `Se3`.")

    def __post_init__(self) -> None:
        for name, value in (("viewmat", as_matrix(self.viewmat, source="world")), ("K", self.K)):
            object.__setattr__(self, name, as_tensor(name, value, floating=True))  # integers would truncate the points
        check_shapes(("viewmat", self.viewmat, "4 4"), ("K", self.K, "3 3"))
        object.__setattr__(self, "origin", as_origin(self.origin))
        for name, size in (("width", self.width), ("height", self.height)):
            check_range(name, size, 1)
            if size % 1:
                raise ValueError(f"{name}: expected a whole number of pixels, got {size!r}; pass an integer")
            object.__setattr__(self, name, int(size))
        if torch.compiler.is_compiling():  # a traced matrix has no values yet
            return
        check_range("near", self.near, 0, closed=(False, False))
        object.__setattr__(self, "near", float(self.near))
        K, E = self.K.detach().double().cpu(), self.viewmat.detach().double().cpu()  # cameras are tiny
        if not (torch.isfinite(K).all() and torch.isfinite(E).all()):
            got = f"NaN or infinity (camera {self.name!r}); leave this view out"
            raise ValueError(f"viewmat, K: expected finite numbers, got {got}")
        if K[0, 1] != 0 or K[1, 0] != 0 or K[2].tolist() != [0.0, 0.0, 1.0]:
            raise ValueError(f"K: expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] without skew, got {K.tolist()}")
        check_range("K[0, 0] (fx)", float(K[0, 0]), 0, closed=(False, False))
        check_range("K[1, 1] (fy)", float(K[1, 1]), 0, closed=(False, False))
        if E[3].tolist() != [0.0, 0.0, 0.0, 1.0]:
            raise ValueError(f"viewmat: expected the last row 0 0 0 1, got {E[3].tolist()}; pass points as columns")
        exact_rotation("viewmat", E[:3, :3])

    @staticmethod
    def look_at(
        eye: Tensor | Sequence[float],  # [3]
        target: Tensor | Sequence[float],  # [3]
        *,
        up: Tensor | Sequence[float] = UP,  # [3]
        fov_degrees: float = 60.0,
        width: int = 640,
        height: int = 480,
        name: str = "",
        near: float = NEAR,
    ) -> Camera:
        """A camera at `eye` with `target` in the middle of its picture, held upright.

        A floating-point tensor `eye` decides dtype and device of the matrices. `up` is the world's up, which is up in the
        picture too; COLMAP's worlds often have no axis that points up: pass `estimate_up(scene.cameras)`. `fov_degrees` is
        the vertical field of view; pixels are square. A ValueError if eye and target are at one place, or `up` is the
        direction of view, which leaves the roll open.
        """
        check_range("fov_degrees", fov_degrees, 0, 180, closed=(False, False))
        like = eye if isinstance(eye, Tensor) and eye.is_floating_point() else torch.zeros(())
        place, aim = (as_tensor(n, point).detach().double().cpu() for n, point in (("eye", eye), ("target", target)))
        check_shapes(("eye", place, "3"), ("target", aim, "3"))
        forward, zenith = unit_vector("target - eye", aim - place), unit_vector("up", up)
        right = torch.linalg.cross(forward, zenith)
        if float(right.norm()) < 1e-6:
            got = f"{zenith.tolist()} for a view along {forward.tolist()}"
            advice = "pass a direction that is up in the picture, for instance (0, 1, 0)"
            raise ValueError(f"up: expected another direction than that of the view, got {got}; {advice}")
        right = right / right.norm()
        R = torch.stack([right, torch.linalg.cross(forward, right), forward])  # x right, y down, z forward
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[:3, :3], viewmat[:3, 3] = R, -R @ place
        focal = height / 2 / math.tan(math.radians(fov_degrees) / 2)
        K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float64)
        return Camera(viewmat.to(like), K.to(like), width, height, name, near=near)

    def __repr__(self) -> str:
        center = to_world(self.center, self.origin)
        fov = 2 * math.degrees(math.atan(self.height / 2 / self.fy))
        lens = "" if self.distortion is None else f", {self.distortion.model}"
        place = ", ".join(f"{value:.{4 if self.origin == ORIGIN else 10}g}" for value in center.tolist())
        return f"Camera({cut(self.name, 80)!r}, {self.width}x{self.height}, fov {fov:.1f}, at ({place}){lens})"

    def resized(self, height: int, width: int) -> Camera:
        """The same view with another number of pixels; the two axes scale independently (kornia's `scale` does not).

        With pixel centres on halves, fx and cx scale by width / self.width, fy and cy by height / self.height, exactly.
        """
        factors = self.K.new_tensor([width / self.width, height / self.height, 1.0])
        return replace(self, K=self.K * factors[:, None], width=width, height=height)

    def fitted(self, longest: int) -> Camera:
        """The same view with at most `longest` pixels on its longer edge."""
        scale = min(1.0, longest / max(self.size))
        return self.resized(max(1, round(scale * self.height)), max(1, round(scale * self.width)))

    def letterboxed(self, height: int, width: int) -> Camera:
        """The same view, complete and in the middle of a picture of another shape, with its pixels as high as wide."""
        scale = min(height / self.height, width / self.width)
        K = self.K * self.K.new_tensor([scale, scale, 1.0])[:, None]
        K[:2, 2] += self.K.new_tensor([width - scale * self.width, height - scale * self.height]) / 2
        return replace(self, K=K, width=width, height=height)

    def with_origin(self, origin: Sequence[float]) -> Camera:  # [3]
        """The same view of the world, with `viewmat` mapping from coordinates counted from another origin."""
        shift = [b - a for a, b in zip(self.origin, as_origin(origin), strict=True)]
        if not any(shift):
            return self
        viewmat = self.viewmat.clone()
        viewmat[:3, 3] += (viewmat[:3, :3].double() @ viewmat.new_tensor(shift, dtype=torch.float64)).to(viewmat)
        return replace(self, viewmat=viewmat, origin=as_origin(origin))

    def to(self, *args: Any, **kwargs: Any) -> Camera:
        """Move or convert the matrices as `Tensor.to` does."""
        return replace(self, viewmat=self.viewmat.to(*args, **kwargs), K=self.K.to(*args, **kwargs))


def kornia_model(K: Tensor, distortion: Distortion | None, size: tuple[int, int]) -> CameraModel:
    """Kornia's model of a projection through a lens: fx, fy, cx, cy and the coefficients, zero where there are fewer."""
    params, kind = K[[0, 1, 0, 1], [0, 1, 2, 2]], CameraModelType.PINHOLE
    if distortion is not None:
        brown = distortion.model == "brown_conrady"
        kind = CameraModelType.BROWN_CONRADY if brown else CameraModelType.KANNALA_BRANDT_K3
        params = torch.cat([params, K.new_tensor((*distortion.coefficients, *[0.0] * 4)[: 8 if brown else 4])])
    return CameraModel(ImageSize(*size), kind, params)


def check_camera(camera: Any) -> None:
    """Raise a TypeError if a function that takes one camera got something else."""
    if not isinstance(camera, Camera):
        advice = "take one of scene.cameras, or convert kornia's with from_kornia"
        raise TypeError(f"camera: expected a Camera, got {type(camera).__name__}; {advice}")


def as_matrix(value: Any, *, source: str | None = None) -> Any:
    """The matrix of kornia's `Se3` (or a batch of one), `So3`, `Quaternion` or `NamedPose`, pycolmap's `Rigid3d`; or the value.

    A ValueError if a `NamedPose` ends in the frame `source`, where it should begin.
    """
    if isinstance(value, NamedPose):
        if value.frame_dst.lower() == source:
            raise ValueError(f"pose: expected one from the {source}, got one that ends there; pass its .inverse()")
        value = value.pose
    if not callable(getattr(value, "matrix", None)):
        return value
    matrix = torch.as_tensor(value.matrix()).squeeze(0)
    return torch.cat([matrix, matrix.new_tensor([[0.0, 0, 0, 1]])]) if matrix.shape == (3, 4) else matrix


def exact_rotation(name: str, matrix: Tensor) -> Tensor:  # [3, 3] -> [3, 3] float64
    """The exact rotation nearest to a rounded one; a ValueError about `name` if it is not orthonormal to 1e-3, or mirrors."""
    M = matrix.detach().double().cpu()
    error = (M @ M.T - torch.eye(3, dtype=torch.float64)).abs().max()
    if not error <= ROTATION_TOLERANCE:  # NaN fails every comparison
        got = f"{M.tolist()}; divide by the scale first"
        raise ValueError(f"{name}: expected a rotation (rigid: without scale or shear), got {got}")
    if torch.linalg.det(M) < 0:
        raise ValueError(f"{name}: expected a rotation, got a reflection (determinant -1); check the axes' handedness")
    U, _, Vh = torch.linalg.svd(M)
    return M.clone() if error < 1e-14 else U @ Vh


def unit_vector(name: str, vector: Tensor | Sequence[float]) -> Tensor:  # [3] float64
    """The direction of a vector; errors name the argument `name`."""
    check_shapes((name, values := as_tensor(name, vector).detach().double().cpu(), "3"))
    length = float(values.norm())
    if not 0 < length < math.inf:
        raise ValueError(f"{name}: expected a vector with a direction, got {values.tolist()}; for instance (0, 0, 1)")
    return values / length


def view_named(cameras: Sequence[Camera], view: Any, where: str) -> Camera:
    """The one camera of a name, with or without its ending; anything else as it is. Errors begin with `where`."""
    if not isinstance(view, str):
        return view
    names = _names(tuple(camera.name for camera in cameras))
    if (name := names.find(view)) is None:
        some = ", ".join([*list(names.names)[:3], "..."])
        raise ValueError(f"{where}: expected the name of a view ({some}), got {view!r}; {names.advice(view)}")
    return next(camera for camera in cameras if camera.name == name)
