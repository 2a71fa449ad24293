"""Problems over matrix inequalities: units, affine functions, samples; feasibility problems that are not designs."""
