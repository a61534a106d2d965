"""Contact of a sensor fitted to labelled frames: the rig, what of material and pins the frames tell, and friction."""

from twin.fit.contact.fit import ContactFit, fit_contact
from twin.fit.contact.parameters import PARAMETERS, Parameter

__all__ = ["PARAMETERS", "ContactFit", "Parameter", "fit_contact"]
