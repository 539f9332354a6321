# One image for every process of the scaled set-up; docker-compose.yml says which one runs what.
FROM python:3.11-slim

# EGL for pictures off screen.
RUN apt-get update \
    && apt-get install -y --no-install-recommends libegl1 libgl1-mesa-dri libgles2 libopengl0 \
    && rm -rf /var/lib/apt/lists/*

ENV PYTHONUNBUFFERED=1 \
    MUJOCO_GL=egl \
    OMP_NUM_THREADS=1 \
    MKL_NUM_THREADS=1 \
    OPENBLAS_NUM_THREADS=1 \
    NUMEXPR_NUM_THREADS=1 \
    UV_COMPILE_BYTECODE=1

# The dependencies change rarely: a layer of their own. TORCH_BACKEND=cu128, say, for CUDA.
ARG TORCH_BACKEND=cpu
WORKDIR /app
RUN pip install --no-cache-dir "uv>=0.13"
COPY pyproject.toml constraints.txt README.md LICENSE ./
RUN uv pip install --system --no-cache --torch-backend=${TORCH_BACKEND} -c constraints.txt \
    -r pyproject.toml --extra postgres
COPY rodif_core rodif_core
COPY server server
COPY worker worker
COPY labeling_ui labeling_ui
COPY migrations migrations
RUN uv pip install --system --no-cache --no-deps .

RUN useradd --create-home --uid 1000 rodif \
    && mkdir -p /var/lib/rodif/artifacts /var/lib/rodif/state \
    && chown -R rodif:rodif /var/lib/rodif
USER rodif
WORKDIR /var/lib/rodif
ENV RODIF_STATE_DIR=/var/lib/rodif/state \
    RODIF_ARTIFACT_DIR=/var/lib/rodif/artifacts \
    RODIF_HOST=0.0.0.0
EXPOSE 8000
CMD ["rodif", "doctor"]
