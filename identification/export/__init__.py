"""A fit as a model for simulators: URDF, MJCF and robot.toml, and what each of them cannot say."""

from .exporting import Exported, Outputs, export_model
from .losses import Loss
from .mechanism import Coupling, Mechanism, mechanism_of
from .stored_model import StoredModel, distrust, model_of_fit
