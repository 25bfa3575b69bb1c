"""Densities and X-ray attenuations of materials. Numpy alone.

Attenuation is 0.1 · density · Σ share · CS_Total_CP(formula, energy) of xraylib 4.3 (Schoonjans et al., Spectrochimica
Acta B 66, 2011), coherent scatter counted in, at the densities that stand here. Tissues are composed as in ICRU Reports
44 and 46. Real things differ in both: dry oak has from 0.6 to 0.9 g/cm³.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from ..errors import SettingError

# Between two of them a straight line in logarithms is 0.4 % off at most.
ENERGIES_KEV = (20, 22, 24, 27, 30, 33, 37, 41, 46, 52, 58, 65, 73, 81, 90, 100, 112, 126, 140, 150)

# Name | g/cm³ | formulas and their shares of the mass | keV of a K edge, mm⁻¹ just below and just above it;
# then mm⁻¹ at the energies.
_TABLE = """
air | 0.001205 | N2 0.755, O2 0.232, Ar 0.013
  9.392e-05 7.579e-05 6.323e-05 5.071e-05 4.269e-05 3.728e-05 3.247e-05 2.927e-05 2.659e-05 2.445e-05
  2.299e-05 2.176e-05 2.074e-05 1.995e-05 1.923e-05 1.857e-05 1.791e-05 1.726e-05 1.67e-05 1.634e-05
water | 1 | H2O
  0.08097 0.06557 0.05492 0.04433 0.03756 0.033 0.02894 0.02625 0.02398 0.02217
  0.02093 0.01987 0.01898 0.01829 0.01766 0.01708 0.01648 0.0159 0.01539 0.01506
soft tissue | 1.06 | H 0.102, C 0.143, N 0.034, O 0.708, Na 0.002, P 0.003, S 0.003, Cl 0.002, K 0.003
  0.08725 0.07058 0.05904 0.04754 0.04018 0.03521 0.03079 0.02786 0.02539 0.02343
  0.02208 0.02094 0.01998 0.01924 0.01857 0.01795 0.01732 0.0167 0.01616 0.01581
fat | 0.95 | H 0.114, C 0.598, N 0.007, O 0.278, Na 0.001, S 0.001, Cl 0.001
  0.05394 0.04518 0.0391 0.03302 0.0291 0.02644 0.02403 0.0224 0.02099 0.01983
  0.01898 0.01824 0.01758 0.01704 0.01653 0.01604 0.01553 0.01501 0.01455 0.01425
cortical bone | 1.92 | H 0.034, C 0.155, N 0.042, O 0.438, P 0.103, S 0.003, Ca 0.225
  0.7672 0.588 0.4626 0.3365 0.2553 0.2006 0.1524 0.1209 0.09529 0.07592
  0.06355 0.05409 0.04703 0.04228 0.03855 0.03562 0.0331 0.03097 0.02936 0.02842
dentine | 2.14 | Ca5P3O13H 0.70, C5H8NO2 0.20, H2O 0.10
  1.025 0.7834 0.6146 0.4448 0.3355 0.2619 0.197 0.1547 0.1202 0.09424
  0.07769 0.06509 0.05574 0.0495 0.04464 0.04086 0.03766 0.035 0.03303 0.03189
enamel | 2.95 | Ca5P3O13H 0.96, H2O 0.04
  1.867 1.423 1.113 0.8002 0.5989 0.4635 0.344 0.2663 0.203 0.1554
  0.1252 0.1023 0.08547 0.07432 0.06576 0.05919 0.05373 0.0493 0.0461 0.0443
pine wood | 0.51 | C6H10O5
  0.03296 0.02711 0.02307 0.01904 0.01645 0.0147 0.01313 0.01208 0.01119 0.01046
  0.009947 0.009506 0.009124 0.008819 0.008535 0.008269 0.007995 0.007718 0.007476 0.007318
oak wood | 0.71 | C6H10O5
  0.04589 0.03775 0.03212 0.0265 0.0229 0.02046 0.01828 0.01682 0.01557 0.01456
  0.01385 0.01323 0.0127 0.01228 0.01188 0.01151 0.01113 0.01075 0.01041 0.01019
polyethylene | 0.94 | C2H4
  0.04056 0.03527 0.03158 0.02787 0.02545 0.02377 0.02223 0.02115 0.02018 0.01934
  0.0187 0.01811 0.01755 0.01708 0.01662 0.01616 0.01568 0.01517 0.01472 0.01442
polypropylene | 0.9 | C3H6
  0.03884 0.03377 0.03024 0.02668 0.02436 0.02276 0.02128 0.02025 0.01932 0.01852
  0.01791 0.01734 0.01681 0.01636 0.01591 0.01548 0.01501 0.01453 0.0141 0.01381
PMMA | 1.18 | C5H8O2
  0.06743 0.05624 0.0485 0.04076 0.03578 0.0324 0.02935 0.02729 0.02551 0.02405
  0.02299 0.02207 0.02125 0.02059 0.01996 0.01936 0.01874 0.01811 0.01755 0.01719
ABS | 1.05 | C15H17N
  0.04701 0.04037 0.03576 0.03112 0.02811 0.02604 0.02415 0.02284 0.02168 0.02069
  0.01995 0.01927 0.01865 0.01813 0.01762 0.01712 0.0166 0.01606 0.01557 0.01526
PVC | 1.4 | C2H3Cl
  0.641 0.4893 0.3833 0.2771 0.2089 0.1631 0.1228 0.0966 0.07533 0.05931
  0.04911 0.04136 0.03561 0.03176 0.02876 0.02642 0.02443 0.02276 0.02152 0.0208
plaster | 1.15 | CaSO6H4
  0.5498 0.4201 0.3294 0.2383 0.1797 0.1402 0.1054 0.08281 0.06437 0.05048
  0.04163 0.0349 0.0299 0.02657 0.02397 0.02195 0.02024 0.01881 0.01776 0.01715
terracotta | 1.9 | SiO2 0.63, Al2O3 0.19, Fe2O3 0.07, CaO 0.05, K2O 0.03, MgO 0.03
  0.7828 0.5995 0.4713 0.3424 0.2593 0.2034 0.154 0.1218 0.09552 0.07567
  0.063 0.05332 0.0461 0.04126 0.03746 0.03449 0.03194 0.0298 0.0282 0.02727
porcelain | 2.4 | SiO2 0.70, Al2O3 0.25, K2O 0.05
  0.6723 0.5154 0.4063 0.2975 0.2279 0.1813 0.1403 0.1137 0.09206 0.07568
  0.06517 0.05708 0.05098 0.04679 0.04345 0.04074 0.03834 0.03624 0.03461 0.03362
limestone | 2.4 | CaCO3
  1.367 1.044 0.818 0.59 0.4429 0.3439 0.2564 0.1994 0.153 0.1181
  0.09583 0.07895 0.06649 0.05821 0.05184 0.04692 0.04281 0.03946 0.03701 0.03563
marble | 2.71 | CaCO3
  1.544 1.179 0.9236 0.6662 0.5002 0.3883 0.2896 0.2252 0.1728 0.1333
  0.1082 0.08915 0.07507 0.06573 0.05853 0.05298 0.04834 0.04455 0.04179 0.04023
glass | 2.5 | SiO2 0.73, Na2O 0.14, CaO 0.09, MgO 0.04
  0.7618 0.5837 0.4598 0.3359 0.2565 0.2033 0.1565 0.1261 0.1014 0.08265
  0.07066 0.06145 0.05452 0.04979 0.04603 0.04302 0.04036 0.03806 0.03628 0.03522
aluminium | 2.7 | Al
  0.9293 0.7081 0.5548 0.4021 0.3047 0.2396 0.1825 0.1456 0.1156 0.09303
  0.07865 0.06766 0.05944 0.05389 0.0495 0.04601 0.04298 0.04038 0.03839 0.03722
titanium | 4.51 | Ti
  7.149 5.444 4.243 3.029 2.242 1.71 1.239 0.9323 0.6823 0.4943
  0.3753 0.2858 0.2207 0.1783 0.1464 0.1227 0.1038 0.08932 0.07955 0.07436
iron | 7.87 | Fe
  20.21 15.47 12.1 8.674 6.436 4.913 3.556 2.665 1.936 1.385
  1.036 0.7725 0.5804 0.4554 0.3618 0.2925 0.2378 0.1964 0.1689 0.1546
brass | 8.44 | Cu 0.63, Zn 0.37
  29.59 22.75 17.87 12.86 9.573 7.323 5.31 3.981 2.888 2.058
  1.53 1.13 0.8374 0.6471 0.5045 0.3991 0.316 0.2534 0.2123 0.191
bronze | 8.8 | Cu 0.88, Sn 0.12 | 29.2001 9.94 13.72
  28.44 21.87 17.18 12.37 12.81 9.939 7.235 5.43 3.957 2.835
  2.11 1.557 1.15 0.8828 0.6816 0.5321 0.4139 0.3248 0.2662 0.236
copper | 8.96 | Cu
  30.28 23.28 18.28 13.15 9.779 7.479 5.421 4.065 2.949 2.102
  1.563 1.155 0.8572 0.6634 0.5182 0.4108 0.3261 0.2623 0.2204 0.1986
silver | 10.49 | Ag | 25.514 9.994 58.11
  19.26 14.88 11.77 50.35 38.48 30.04 22.2 16.88 12.4 8.913
  6.631 4.869 3.557 2.69 2.032 1.541 1.152 0.8594 0.6676 0.5692
lead | 11.34 | Pb | 88.0045 2.166 8.712
  97.95 76.51 61.09 45.08 34.38 26.82 19.92 15.27 11.32 8.236
  6.21 4.635 3.451 2.66 8.227 6.292 4.728 3.522 2.71 2.285
gold | 19.32 | Au | 80.7249 4.128 17.2
  152.3 118.8 94.74 69.81 53.18 41.42 30.72 23.51 17.41 12.66
  9.546 7.125 5.308 17.05 13.03 9.965 7.478 5.557 4.267 3.593
"""


@dataclass(frozen=True, eq=False)
class TabulatedMaterial:
    """A material and how much it attenuates.

    Attributes:
        name: as the user chooses it.
        density_g_cm3: mass density.
        formulas: chemical formulas and their shares of the mass.
        energies_kev: (E,) ascending; a K edge is two of them that differ by nothing that matters.
        attenuations_mm_inv: (E,).
    """

    name: str
    density_g_cm3: float
    formulas: tuple[tuple[str, float], ...]
    energies_kev: np.ndarray
    attenuations_mm_inv: np.ndarray

    def attenuation(self, energy_kev: float) -> float:
        """mm⁻¹ at a photon energy, by straight lines in logarithms, within 0.5 % of xraylib's.

        Raises:
            SettingError: the table does not reach so far.
        """
        first, last = ENERGIES_KEV[0], ENERGIES_KEV[-1]
        if not first <= energy_kev <= last:
            raise SettingError(
                "The photon energy is {energy_kev:g} keV; give one of {first} to {last} keV.",
                energy_kev=energy_kev,
                first=first,
                last=last,
            )
        energies, values = np.log(self.energies_kev), np.log(self.attenuations_mm_inv)
        return float(np.exp(np.interp(np.log(energy_kev), energies, values)))


def find_material(name: str) -> TabulatedMaterial:
    """A material by its name, whatever its case, "_" for a space.

    Raises:
        SettingError: there is no such one; names those that there are.
    """
    found = _BY_NAME.get(name.strip().replace("_", " ").lower())
    if found is None:
        raise SettingError(
            "There is no material '{name}'; choose among {known}.",
            name=name,
            known=", ".join(m.name for m in MATERIALS),
        )
    return found


def _parse(block: str) -> TabulatedMaterial:
    head, *rows = block.split("\n  ")
    name, density, composition, *edge = (part.strip() for part in head.split("|"))
    energies, values = np.array(ENERGIES_KEV, np.float64), np.array(" ".join(rows).split(), np.float64)
    if edge:
        at, below, above = map(float, edge[0].split())
        place = int(np.searchsorted(energies, at))
        energies = np.insert(energies, place, [at, np.nextafter(at, np.inf)])
        values = np.insert(values, place, [below, above])
    pairs = (part.split() for part in composition.split(","))
    formulas = tuple((formula, float(share[0]) if share else 1.0) for formula, *share in pairs)
    return TabulatedMaterial(name, float(density), formulas, energies, values)


MATERIALS = tuple(_parse(block) for block in re.split(r"\n(?! )", _TABLE.strip()))
_BY_NAME = {material.name.lower(): material for material in MATERIALS}
