"""The Tac-VGNN paper's comparison, repeated: graphs, models, training efficiency, what the areas show."""
