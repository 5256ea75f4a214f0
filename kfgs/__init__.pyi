"""The public names of kfgs; each is imported when it is first used."""

from .cameras import Camera as Camera
from .cameras import resize_map as resize_map
from .evaluation import score_views as score_views
from .fields import SemanticField as SemanticField
from .fields import Training as Training
from .fields import label_set_from_examples as label_set_from_examples
from .formats import read_splats as read_splats
from .formats import write_splats as write_splats
from .gaussians import Gaussians as Gaussians
from .labels import EditList as EditList
from .labels import OfClass as OfClass
from .labels import Recolor as Recolor
from .labels import Remove as Remove
from .labels import connected_parts as connected_parts
from .labels import load_label_set as load_label_set
from .labels import transfer_labels as transfer_labels
from .pipeline import ColorConfig as ColorConfig
from .pipeline import Paper as Paper
from .pipeline import Uplift as Uplift
from .pipeline import attach as attach
from .pipeline import fit as fit
from .pipeline import fit_color as fit_color
from .pipeline import score_scene as score_scene
from .pipeline import segment_scene as segment_scene
from .quant import AutoencoderConfig as AutoencoderConfig
from .quant import GrownCodebook as GrownCodebook
from .quant import PaperCodebook as PaperCodebook
from .quant import fit_autoencoder as fit_autoencoder
from .quant import fit_codebook as fit_codebook
from .quant import quantize_maps as quantize_maps
from .scenes import FeatureFolder as FeatureFolder
from .scenes import extract_features as extract_features
from .scenes import load_scene as load_scene
from .scenes import run_sfm as run_sfm
from .splat import rasterize as rasterize
from .teachers import load_teacher as load_teacher
from .teachers import make_label_set as make_label_set
from .toy import ToyConfig as ToyConfig
from .toy import make_toy_room as make_toy_room
from .viewer import explore as explore

__version__: str
