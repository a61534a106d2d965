"""Fit of a sensor's contact to labelled frames: the rig, friction, and the properties of material and pins that the frames determine."""

from twin.calibration.contact.fit import PARAMETERS, ContactFit, FittedParameter, fit_contact
