"""Action chunking with a transformer: a small conditional VAE over chunks (Zhao et al. 2023, arXiv 2304.13705)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from mjhab.learning.configs import StudentConfig
from mjhab.learning.devices import normal
from mjhab.learning.networks import Encoder, Normalizer
from mjhab.learning.observation.spec import ObservationSpec
from mjhab.learning.students.student import Batch, Student

HEADS = 4
LATENT_WIDTH = 16
KL_WEIGHT = 10.0
"""Weight of the latent's mean KL divergence per dimension (arXiv 2304.13705, Table III)."""


class ActionTransformer(Student):
    """Transformer over image, vector and latent tokens, with one query per action of the chunk.

    In training the latent encodes the demonstrated chunk; the acting policy sets it to 0.
    """

    def __init__(self, config: StudentConfig, layout: ObservationSpec) -> None:
        super().__init__(config, layout)
        width = config.network.hidden
        layers = config.network.layers
        self.encoder = Encoder(config, layout)
        self.image_tokens = nn.ModuleList(
            nn.Linear(config.network.image_features, width)
            for _ in range(self.encoder.cameras)
        )
        self.vector_token = nn.Linear(self.encoder.vector_width, width)
        self.latent_token = nn.Linear(LATENT_WIDTH, width)
        self.action_token = nn.Linear(len(layout.actions), width)
        # The usual scale of learned positions in transformers: small beside the tokens.
        self.chunk_places = nn.Parameter(0.02 * torch.randn(config.chunk, width))
        self.queries = nn.Parameter(0.02 * torch.randn(config.chunk, width))
        self.style_query = nn.Parameter(0.02 * torch.randn(1, width))
        self.style_encoder = nn.TransformerEncoder(
            # Torch warns that nested tensors do not go with norm_first.
            _encoder_layer(width),
            layers,
            enable_nested_tensor=False,
        )
        self.style_head = nn.Linear(width, 2 * LATENT_WIDTH)
        self.context = nn.TransformerEncoder(
            _encoder_layer(width), layers, enable_nested_tensor=False
        )
        decoder = nn.TransformerDecoderLayer(
            width, HEADS, 4 * width, 0.0, batch_first=True, norm_first=True
        )
        self.decoder = nn.TransformerDecoder(decoder, 1)
        self.head = nn.Linear(width, len(layout.actions))

    @property
    def normalizer(self) -> Normalizer:
        return self.encoder.normalizer

    def predict(self, images: list[Tensor], vector: Tensor, latent: Tensor) -> Tensor:
        """Normalized actions (B, chunk, A) from image features, the vector and a latent (B, LATENT_WIDTH)."""
        tokens = [
            to_token(image)
            for to_token, image in zip(self.image_tokens, images, strict=True)
        ]
        tokens += [self.vector_token(vector), self.latent_token(latent)]
        memory = self.context(torch.stack(tokens, dim=1))
        queries = self.queries.expand(len(vector), -1, -1)
        return self.head(self.decoder(queries, memory))

    def style(
        self, vector: Tensor, target: Tensor, valid: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Mean and logarithm of the variance (B, LATENT_WIDTH) of the latent of demonstrated chunks."""
        actions = self.action_token(target) + self.chunk_places
        head = self.style_query.expand(len(vector), -1, -1)
        tokens = torch.cat([head, self.vector_token(vector)[:, None], actions], dim=1)
        seen = torch.ones(len(vector), 2, dtype=torch.bool, device=valid.device)
        # Actions past the end of an episode are repeated ones, which say nothing of the style.
        hidden = ~torch.cat([seen, valid], dim=1)
        encoded = self.style_encoder(tokens, src_key_padding_mask=hidden)[:, 0]
        mean, log_variance = self.style_head(encoded).chunk(2, dim=1)
        return mean, log_variance

    def loss(self, batch: Batch, random: torch.Generator) -> Tensor:
        images, vector = self.encoder(batch.vector, batch.images)
        target = self.targets(batch)
        mean, log_variance = self.style(vector, target, batch.valid)
        noise = normal(mean.shape, random, mean)
        predicted = self.predict(
            images, vector, mean + noise * (0.5 * log_variance).exp()
        )
        divergence = -0.5 * (1.0 + log_variance - mean**2 - log_variance.exp()).mean()
        return self.error(predicted, batch, target) + KL_WEIGHT * divergence

    def chunk(self, vector: Tensor, images: Tensor, noise: Tensor) -> Tensor:
        features, normalized = self.encoder(vector, images)
        # The mean of the prior, as in the original.
        latent = torch.zeros(len(vector), LATENT_WIDTH, device=vector.device)
        return self.action_normalizer.restore(self.predict(features, normalized, latent))


def _encoder_layer(width: int) -> nn.TransformerEncoderLayer:
    return nn.TransformerEncoderLayer(
        width, HEADS, 4 * width, 0.0, batch_first=True, norm_first=True
    )
