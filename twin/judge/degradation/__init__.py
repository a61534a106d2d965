"""Measurement of how far a sensor may degrade before its pins are lost, by known degradations of growing severity and known truth."""
