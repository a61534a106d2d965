raise RuntimeError("its maker has left")
