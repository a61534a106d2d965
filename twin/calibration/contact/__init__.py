"""Fit of a sensor's contact to labelled frames: the rig, friction, and the properties of material and pins that the frames determine."""

from twin.calibration.contact.fit import ContactFit, fit_contact
from twin.calibration.contact.parameters import PARAMETERS, FittedParameter
