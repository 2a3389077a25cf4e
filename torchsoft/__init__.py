"""torchsoft: a differentiable simulator of soft contact manipulation."""
