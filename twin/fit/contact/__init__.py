"""Fit of a sensor's contact to labelled frames: the rig, friction, and the properties of material and pins that the frames determine."""

from twin.fit.contact.fit import ContactFit, fit_contact
from twin.fit.contact.parameters import PARAMETERS, Parameter

__all__ = ["PARAMETERS", "ContactFit", "Parameter", "fit_contact"]
