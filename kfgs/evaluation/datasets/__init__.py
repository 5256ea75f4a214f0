"""Ground truth of published data sets, and of any folder of labels. Poses and pictures come from `kfgs.scenes.load_scene`."""

from ...labels.polygons import decode_rle, encode_rle, fill_polygon, fill_region
from .coco import load_coco_examples, load_coco_labels, load_coco_masks, save_coco
from .find import find_labels, find_masks, find_points
from .label_folder import load_labels
from .legaussians import load_legaussians
from .lerf_ovs import load_lerf_ovs
from .ovs3d import OVS3D_REPORTED, OVS3D_SCENES, load_3dovs
from .replica import load_replica_points, load_semantic_nerf_labels
from .scannet import load_scannet_points
from .scenesplat import load_scenesplat_points
from .surface_points import load_surface_points
from .views import truth_views

__all__ = [
    "OVS3D_REPORTED",
    "OVS3D_SCENES",
    "decode_rle",
    "encode_rle",
    "fill_polygon",
    "fill_region",
    "find_labels",
    "find_masks",
    "find_points",
    "load_3dovs",
    "load_coco_examples",
    "load_coco_labels",
    "load_coco_masks",
    "load_labels",
    "load_legaussians",
    "load_lerf_ovs",
    "load_replica_points",
    "load_scannet_points",
    "load_scenesplat_points",
    "load_semantic_nerf_labels",
    "load_surface_points",
    "save_coco",
    "truth_views",
]
