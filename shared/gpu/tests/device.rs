//! The device opens with validation, runs work, retires what is dropped, and says nothing to the layers.

use shadecast_gpu::{
    Access, Bind, BindGroup, Buffer, ComputePipeline, DesktopDevice, Gpu, GpuOptions, Memory, Needs,
};
use shadecast_shaders::generated::{BENCH_FETCH_COMP, BenchFetchPush};
use std::sync::Arc;

fn open(needs: Needs) -> Arc<Gpu> {
    let options = GpuOptions { needs, validation: true, device_name: None };
    Gpu::open(&options, &DesktopDevice).expect("a Vulkan device; `./shadecast setup` installs a software one")
}

#[test]
fn both_feature_sets_open_and_pass_the_multiview_self_test_without_a_validation_message() {
    for needs in [Needs::Server, Needs::Client] {
        let gpu = open(needs);
        assert_eq!(gpu.validation_messages(), 0, "{:?}", gpu.validation_texts());
    }
}

#[test]
fn copies_arrive_and_buffers_dropped_while_in_use_outlive_the_work() {
    let gpu = open(Needs::Client);
    let data: Vec<u32> = (0..1000).collect();
    let source = Buffer::upload(&gpu, "source", &data).unwrap();
    let target = Buffer::new(&gpu, "target", 4000, Memory::Readback).unwrap();
    let mut recorder = gpu.record().unwrap();
    recorder.scope("copy", |r| r.copy_buffer(&source, 0, &target, 0, 4000));
    recorder.barrier(Access::COPY_WRITE, Access::HOST_READ);
    let ticket = recorder.submit().unwrap();
    drop(source);
    gpu.wait(ticket).unwrap();
    assert_eq!(&target.values::<u32>()[..1000], &data[..]);
    assert_eq!(gpu.take_timings_ms().len(), 1);
    assert_eq!(gpu.validation_messages(), 0, "{:?}", gpu.validation_texts());
}

#[test]
fn an_unknown_device_name_is_an_error_that_lists_what_there_is() {
    let options =
        GpuOptions { needs: Needs::Client, validation: false, device_name: Some("no such device".into()) };
    let error = Gpu::open(&options, &DesktopDevice).expect_err("refused").to_string();
    assert!(error.contains("not the one asked for"), "{error}");
}

/// Validation messages of two dispatches of which the second reads what the first writes.
fn messages_of_two_dispatches(gpu: &Arc<Gpu>, barrier: bool) -> u32 {
    let pipeline = ComputePipeline::new(gpu, &BENCH_FETCH_COMP).unwrap();
    let data = vec![[0.0f32; 4]; 128];
    let buffers = ["a", "b", "c"].map(|name| Buffer::upload(gpu, name, &data).unwrap());
    let group = |table: usize, sums: usize| {
        let binds = [("Table", Bind::Buffer(&buffers[table])), ("Sums", Bind::Buffer(&buffers[sums]))];
        BindGroup::new(pipeline.layout(), &binds).unwrap()
    };
    let (first, second) = (group(0, 1), group(1, 2));
    let push = BenchFetchPush { fetches: 4, mask: 127 };
    let before = gpu.validation_messages();
    let mut recorder = gpu.record().unwrap();
    recorder.dispatch(&pipeline, &first, &push, [1, 1, 1]);
    if barrier {
        recorder.barrier(Access::COMPUTE_WRITE, Access::COMPUTE_READ);
    }
    recorder.dispatch(&pipeline, &second, &push, [1, 1, 1]);
    let ticket = recorder.submit().unwrap();
    gpu.wait(ticket).unwrap();
    gpu.validation_messages() - before
}

/// lavapipe does all in order, so that a missing barrier shows nowhere but in the layer's messages: this is how we know
/// that there would be some.
#[test]
fn a_missing_barrier_is_told_by_the_layers_and_a_barrier_ends_it() {
    let gpu = open(Needs::Server);
    if !gpu.checks_synchronisation() {
        eprintln!("SKIPPED: the installed validation layer cannot be asked to look for missing barriers");
        return;
    }
    assert_eq!(messages_of_two_dispatches(&gpu, true), 0, "{:?}", gpu.validation_texts());
    assert!(messages_of_two_dispatches(&gpu, false) > 0, "the layer did not see a hazard");
    assert!(gpu.validation_texts()[0].contains("HAZARD"), "{:?}", gpu.validation_texts());
}
