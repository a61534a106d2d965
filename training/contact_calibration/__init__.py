"""Contact of a sensor fitted to labelled frames: the rig, what of material and pins the frames tell, and friction."""

from training.contact_calibration.fit import ContactFit, fit_contact
from training.contact_calibration.parameters import PARAMETERS, Parameter

__all__ = ["PARAMETERS", "ContactFit", "Parameter", "fit_contact"]
