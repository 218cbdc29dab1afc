"""The resistance of yachts by the shape of their hulls, in scikit-learn.

Measured in Delft (UCI Machine Learning Repository, CC BY 4.0): the repository has
paper/published/data/README.md on them.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from sklearn.ensemble import GradientBoostingRegressor
from sklearn.model_selection import train_test_split

from gpadjust import FunctionPhysics, Unknown
from gpadjust.sklearn import CKARegressor

DATA = Path(__file__).with_name("yacht.csv")
table = np.loadtxt(DATA, delimiter=",", skiprows=1)
X, y = table[:, :6], table[:, 6]  # resistance over weight, times 1000

unknowns = {"resistance": Unknown(5.0, factor=3.0), "exponent": Unknown(-3.0, sd=3.0)}
wave = FunctionPhysics(  # of Froude's number (Holtrop and Mennen 1982)
    lambda X, p: p.resistance * (p.exponent * (X[:, 5] ** -0.9 - 0.35**-0.9)).exp(),
    unknowns=unknowns,
)
X_train, X_test, y_train, y_test = train_test_split(X, y, train_size=60, random_state=0)
models = {
    "formula, adjusted": CKARegressor(wave, random_state=0),
    "boosted trees": GradientBoostingRegressor(random_state=0),
}
errors = {}
for name, model in models.items():
    model.fit(X_train, y_train)
    errors[name] = model.predict(X_test) - y_test
rmse = {name: np.sqrt(np.mean(error**2)) for name, error in errors.items()}
adjusted, trees = rmse.values()
print(
    f"From 60 of 308 runs the adjusted formula predicts the others with an error of "
    f"{adjusted:.2f}, boosted trees with {trees:.2f}."
)

figure, axes = plt.subplots(figsize=(5, 3), layout="constrained")
for (name, error), marker in zip(errors.items(), (".", "x"), strict=True):
    axes.plot(X_test[:, 5], error, marker, label=name)
axes.axhline(0, color="0.7", linewidth=1)
axes.set(xlabel="Froude number", ylabel="error of the resistance")
axes.legend(frameon=False)
figure.savefig("yacht.png")
