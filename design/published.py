"""The paper's printed gains, as data. Neither pair satisfies the paper's own condition: nothing here is certified."""

from controller.coupling import SpringDamper

#: (27), case I: Lambda = Theta Psi
CASE_I = SpringDamper(K=[2870.0, 2320.0], B=[5.47, 5.55])
#: (28), case II: Lambda = I
CASE_II = SpringDamper(K=[1810.0, 120.0], B=[5.78, 3.81])

#: The transparency indices (25) printed beside them [dB]; no reading of Figure 4 that we tried gives them.
PRINTED_TAU_DB = {"I": -4.15, "II": -3.09}

PUBLISHED = {"I": CASE_I, "II": CASE_II}
