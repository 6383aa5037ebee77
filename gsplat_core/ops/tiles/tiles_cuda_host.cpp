#include "tile_lists.h"

namespace gsplat::tiles {

// Instances with an out-of-range image_id are dropped; to reject them as the CPU does, the host would have to wait.
TileLists make_lists(Call& call, const Splats& splats, const ListOptions& options) {
  const SplatBoxes& boxes = splats.boxes;
  TileLists lists = {call.empty({boxes.count}, ScalarType::Int), {}, {}, {}, {}};
  TileOrder order = {};
  if (boxes.count > 0)
    order = order_splats(boxes, options.sort, lists.tile_counts.mutable_data_ptr<int32_t>(), call, call.stream);
  TileInstances instances = {};
  const int64_t* const total = order.starts + boxes.count;
  if (options.capacity) {
    instances.capacity = true;
    instances.count = *options.capacity;
    lists.needed = call.empty({1}, ScalarType::Long);
    int64_t* const out = lists.needed.mutable_data_ptr<int64_t>();
    check_cuda(boxes.count > 0 ? cudaMemcpyAsync(out, total, sizeof(int64_t), cudaMemcpyDeviceToDevice, call.stream)
                               : cudaMemsetAsync(out, 0, sizeof(int64_t), call.stream),
               "keeping the number of instances");
  } else if (boxes.count > 0) {
    // The only host synchronisation: it provides the number of instances, so that the returned lists have the exact
    // length.
    check_cuda(cudaMemcpyAsync(&instances.count, total, sizeof(int64_t), cudaMemcpyDeviceToHost, call.stream),
               "reading the number of instances");
    check_cuda(cudaStreamSynchronize(call.stream), "sorting the splats by depth");
  }
  check(instances.count <= kMostInts, "the splats touch ", instances.count,
        " tiles in all, more than 2^31 - 1; render fewer images at a time or with a larger tile_size");
  Tensor sorted[2];
  for (int i = 0; i < (options.sort ? 2 : 1); ++i) {
    sorted[i] = call.empty({instances.count}, ScalarType::Int);
    instances.splats[i] = sorted[i].mutable_data_ptr<int32_t>();
    instances.tiles[i] = call.array<uint32_t>(instances.count);
  }
  emit_instances(boxes, order, instances, call.stream);
  if (options.sort) sort_by_tile(boxes, instances, call, call.stream);
  lists.flatten_ids = sorted[instances.current];
  if (options.ids) {
    lists.ids = call.empty({instances.count}, ScalarType::Long);
    make_ids(boxes, instances, lists.ids.mutable_data_ptr<int64_t>(), call.stream);
  }
  if (options.offsets) {
    lists.offsets = call.empty({boxes.images, boxes.tile_height, boxes.tile_width}, ScalarType::Int);
    encode_offsets(instances, splats.tiles, lists.offsets.mutable_data_ptr<int32_t>(), call.stream);
  }
  return lists;
}

void offsets_of_ids(const Call& call, const Tensor& ids, int64_t images, int64_t tiles_per_image, int32_t* offsets) {
  encode_offsets(ids.const_data_ptr<int64_t>(), ids.numel(), images, tiles_per_image, offsets, call.stream);
}

}  // namespace gsplat::tiles
