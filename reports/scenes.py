"""Which scenes a table is about: those of a published data set, and others that stand in for them."""

from __future__ import annotations

from dataclasses import dataclass

from padgs.reports import published

BUILT_IN = "synthetic"  # data set of the scenes that are generated; their names begin with it
OUTDOOR_WORDS = ("outdoor", "garden")  # what a scene outside the data sets is called if it belongs to Table 2


@dataclass(frozen=True)
class Place:
    """A scene of a data set, as results name them."""

    dataset: str
    scene: str
    apart: str = ""  # what sets its runs apart from others of the scene, with which they must not stand together

    @property
    def published(self) -> bool:
        """Whether the paper has numbers of it."""
        return self.dataset in published.DATASETS

    @property
    def outdoor(self) -> bool:
        """Whether it belongs beside the outdoor scenes of Ricoh360."""
        return self.dataset == "ricoh360" or any(word in self.scene for word in OUTDOOR_WORDS)

    @property
    def title(self) -> str:
        """What stands over its rows: nobody shall take a stand-in for a scene of the paper."""
        if self.published:
            return self.heading
        if not self.dataset:
            return f"{self.label} (a capture that is no scene of the paper)"
        origin = "built in, generated" if self.dataset == BUILT_IN else f"of {self.dataset}"
        return f"{self.label} ({origin}; no scene of the paper)"

    @property
    def stem(self) -> str:
        """Its label in the names of files, which no other place shares: with the data set, where the scene's own name
        does not say it.
        """
        said = BUILT_IN if self.scene.startswith(f"{BUILT_IN}-") else ""
        return self.label if self.dataset == said else f"{self.label}_{self.dataset or 'capture'}"

    @property
    def heading(self) -> str:
        """The same without a word on where it is from, for tables that have such scenes as well."""
        return ", ".join(filter(None, (published.scene_title(self.dataset, self.scene), self.apart)))

    @property
    def label(self) -> str:
        """Its name, and what sets its runs apart."""
        return ", ".join(filter(None, (self.scene, self.apart)))

    @property
    def rank(self) -> tuple[int, str, str, str]:
        """Scenes of the paper stand first, otherwise in the order of their names."""
        order = list(published.DATASETS)
        return (order.index(self.dataset) if self.published else len(order), self.dataset, self.scene, self.apart)
