# The workstation with an NVIDIA GPU: everything. torch's own wheels bring CUDA; the host needs the driver only.
#   docker build -f docker/train.Dockerfile -t cohdc-train .
#   docker run --rm --gpus all --shm-size 8g --user "$(id -u):$(id -g)" -v "$PWD:/data" cohdc-train fit DATA
# .ci/check_docker runs the install steps without docker.
FROM python:3.11-slim
RUN useradd --create-home cohdc && install -d -o cohdc /data
WORKDIR /opt/cohdc
COPY pyproject.toml README.md LICENSE constraints.txt ./
COPY cohdc_train cohdc_train
COPY configs configs
RUN python3 -m pip install --no-cache-dir -c constraints.txt '.[train]'
ENV NVIDIA_VISIBLE_DEVICES=all
ENV NVIDIA_DRIVER_CAPABILITIES=compute,utility
# Downloaded weights and caches go where any --user may write.
ENV HOME=/tmp
USER cohdc
RUN cohdc env && cohdc export --help > /dev/null
WORKDIR /data
ENTRYPOINT ["cohdc"]
CMD ["--help"]
