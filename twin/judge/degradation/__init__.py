"""How far a sensor may degrade before its pins are lost: known degradations, growing, against known truth."""
