//! The device opens with validation, runs work, retires dropped objects, and causes no validation message.

use generated::{ADD_COMP, AddPush};
use shadecast_gpu::{
    Access, Attachment, Bind, BindGroup, Buffer, ComputePipeline, DesktopDevice, Framebuffer, Gpu,
    GpuOptions, Image, ImageDesc, Memory, Needs, RenderPass, RenderPassDesc, vk,
};
use std::sync::Arc;
use std::time::Duration;

/// `glsl/` beside this file, compiled by the build script.
mod generated {
    #![allow(clippy::unreadable_literal, unused_qualifications)]
    include!(concat!(env!("OUT_DIR"), "/tests.rs"));
}

fn open(needs: Needs) -> Arc<Gpu> {
    let options = GpuOptions { needs, validation: true, device_name: None };
    Gpu::open(&options, &DesktopDevice).expect("a Vulkan device; `./shadecast setup` installs a software one")
}

#[test]
fn both_feature_sets_pass_the_multiview_self_test() {
    for needs in [Needs::Server, Needs::Client] {
        let gpu = open(needs);
        assert_eq!(gpu.validation_messages(), 0, "{:?}", gpu.validation_texts());
    }
}

#[test]
fn a_device_without_validation_is_not_reported_as_clean() {
    let options = GpuOptions { needs: Needs::Client, validation: false, device_name: None };
    let gpu = Gpu::open(&options, &DesktopDevice).expect("a Vulkan device");
    assert_eq!(gpu.checked_messages(), None);
    assert_eq!(open(Needs::Client).checked_messages(), Some(0));
}

#[test]
fn dropped_buffers_outlive_their_work() {
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
    assert_eq!(gpu.validation_messages(), 0, "{:?}", gpu.validation_texts());
}

#[test]
fn who_waits_for_a_recording_sees_its_timings_and_no_others() {
    let gpu = open(Needs::Client);
    let target = Buffer::new(&gpu, "target", 4096, Memory::Device).unwrap();
    let submit = |scopes: &[&'static str]| {
        let mut recorder = gpu.record().unwrap();
        scopes.iter().for_each(|name| recorder.scope(name, |r| r.fill(&target, 0)));
        recorder.submit().unwrap()
    };
    let (first, silent, second) = (submit(&["a", "b"]), submit(&[]), submit(&["c"]));
    let seen = |ticket| gpu.wait_timed(ticket).unwrap().iter().map(|(name, _)| name).collect::<Vec<_>>();
    assert_eq!(seen(second), ["c"]);
    assert_eq!(seen(first), ["a", "b"]);
    assert_eq!(seen(silent), [""; 0]);
}

#[test]
fn recordings_of_both_queues_are_waited_for_separately() {
    let gpu = open(Needs::Server);
    let target = Buffer::new(&gpu, "target", 4096, Memory::Device).unwrap();
    let back = Buffer::new(&gpu, "back", 4096, Memory::Readback).unwrap();
    for round in 1u32..6 {
        let mut recorder = gpu.record().unwrap();
        recorder.fill(&target, round);
        let main = recorder.submit().unwrap();
        gpu.wait(main).unwrap();
        // The next of the main queue is under way, or waits, while the other queue reads what the last one wrote.
        let other = Buffer::new(&gpu, "other", 1 << 20, Memory::Device).unwrap();
        let mut recorder = gpu.record().unwrap();
        recorder.fill(&other, round);
        let next = recorder.submit().unwrap();
        let mut recorder = gpu.record().unwrap();
        recorder.copy_buffer(&target, 0, &back, 0, 4096);
        recorder.barrier(Access::COPY_WRITE, Access::HOST_READ);
        let beside = recorder.submit_beside().unwrap();
        drop(other);
        gpu.wait(beside).unwrap();
        assert!(gpu.is_done(beside).unwrap());
        let words = back.values::<u32>();
        assert!(words.iter().all(|word| *word == round), "round {round}");
        gpu.wait(next).unwrap();
        assert!([main, next, beside].into_iter().all(|ticket| gpu.is_done(ticket).unwrap()));
    }
    assert_eq!(gpu.validation_messages(), 0, "{:#?}", gpu.validation_texts());
}

/// One thread asks for and waits for what another submits, while the first takes slots back: no fence is another recording's by then.
#[test]
fn threads_wait_for_recordings_that_others_take_back() {
    let gpu = open(Needs::Server);
    let target = Buffer::new(&gpu, "target", 4096, Memory::Device).unwrap();
    let (to, tickets) = std::sync::mpsc::channel();
    std::thread::scope(|scope| {
        let waits = || {
            for ticket in tickets {
                gpu.wait_at_most(ticket, Duration::from_secs(60)).unwrap();
                gpu.wait(ticket).unwrap();
                assert!(gpu.is_done(ticket).unwrap());
            }
        };
        scope.spawn(waits);
        for round in 0..400 {
            let mut recorder = gpu.record().unwrap();
            recorder.fill(&target, round);
            recorder.barrier(Access::COPY_WRITE, Access::COPY_WRITE);
            let ticket = recorder.submit().unwrap();
            to.send(ticket).unwrap();
            while round % 3 == 0 && !gpu.is_done(ticket).unwrap() {}
        }
        drop(to);
    });
    assert_eq!(gpu.validation_messages(), 0, "{:#?}", gpu.validation_texts());
}

#[test]
fn what_is_left_to_another_is_destroyed_by_it_alone() {
    let gpu = open(Needs::Client);
    gpu.leave_retired();
    let held = || gpu.memory().iter().filter(|used| used.name == "dropped").count();
    let dropped = Buffer::new(&gpu, "dropped", 4096, Memory::Device).unwrap();
    drop(dropped);
    for _ in 0..2 {
        let ticket = gpu.record().unwrap().submit().unwrap();
        gpu.wait(ticket).unwrap();
    }
    assert!(gpu.is_done(gpu.record().unwrap().submit().unwrap()).is_ok());
    assert_eq!(held(), 1, "whoever records destroys nothing");
    gpu.destroy_retired();
    assert_eq!(held(), 0);
    assert_eq!(gpu.validation_messages(), 0, "{:#?}", gpu.validation_texts());
}

#[test]
fn a_large_buffer_returns_its_memory_beside_small_ones() {
    let gpu = open(Needs::Client);
    let large_bytes = 24 << 20;
    let buffer = |name, bytes| Buffer::new(&gpu, name, bytes, Memory::Device).unwrap();
    let large = [0; 2].map(|_| buffer("large", large_bytes));
    let _small = buffer("small", 4096);
    let before_bytes = gpu.reserved_bytes();
    drop(large);
    gpu.wait(gpu.record().unwrap().submit().unwrap()).unwrap();
    gpu.destroy_retired();
    assert_eq!(gpu.reserved_bytes(), before_bytes - 2 * large_bytes);
    assert_eq!(gpu.validation_messages(), 0, "{:#?}", gpu.validation_texts());
}

#[test]
fn an_unknown_device_name_is_an_error_that_lists_what_there_is() {
    let options =
        GpuOptions { needs: Needs::Client, validation: false, device_name: Some("no such device".into()) };
    let error = Gpu::open(&options, &DesktopDevice).expect_err("refused").to_string();
    assert!(error.contains("not the one asked for"), "{error}");
}

#[test]
fn a_dispatch_covers_each_item_without_a_spare_workgroup() {
    let gpu = open(Needs::Client);
    let pipeline = ComputePipeline::new(&gpu, &ADD_COMP).unwrap();
    let [workgroup, ..] = pipeline.workgroup();
    let terms = Buffer::upload(&gpu, "terms", &vec![[1.0f32; 4]; 4 * workgroup as usize]).unwrap();
    let sums = Buffer::new(&gpu, "sums", u64::from(4 * workgroup) * 16, Memory::Readback).unwrap();
    let binds = [("Terms", Bind::Buffer(&terms)), ("Sums", Bind::Buffer(&sums))];
    let group = BindGroup::new(pipeline.layout(), &binds).unwrap();
    for (items, groups) in [(1, 1), (workgroup, 1), (workgroup + 1, 2), (3 * workgroup - 1, 3)] {
        let mut recorder = gpu.record().unwrap();
        recorder.fill(&sums, 0);
        recorder.barrier(Access::COPY_WRITE, Access::COMPUTE_WRITE);
        recorder.dispatch(&pipeline, &group, &AddPush { added: 1.0 }, [items, 1, 1]);
        recorder.barrier(Access::COMPUTE_WRITE, Access::HOST_READ);
        gpu.wait(recorder.submit().unwrap()).unwrap();
        let written = sums.values::<[f32; 4]>().iter().filter(|sum| sum[0] != 0.0).count();
        assert_eq!(written, (groups * workgroup) as usize, "{items} items");
    }
}

#[test]
fn pipelines_of_the_same_shader_are_one_while_one_is_in_use_or_held() {
    let gpu = open(Needs::Client);
    let pipeline = || ComputePipeline::new(&gpu, &ADD_COMP).unwrap();
    let (first, second) = (pipeline(), pipeline());
    assert!(Arc::ptr_eq(first.layout(), second.layout()));
    let layout = Arc::downgrade(first.layout());
    let held = gpu.hold_pipelines();
    drop((first, second));
    assert!(layout.upgrade().is_some_and(|layout| Arc::ptr_eq(&layout, pipeline().layout())), "it is held");
    drop(held);
    assert!(layout.upgrade().is_none(), "nobody uses it any more");
    drop(pipeline());
    assert_eq!(gpu.validation_messages(), 0, "{:#?}", gpu.validation_texts());
}

/// Validation messages of two dispatches of which the second reads what the first writes.
fn messages_of_two_dispatches(gpu: &Arc<Gpu>, barrier: bool) -> u32 {
    let pipeline = ComputePipeline::new(gpu, &ADD_COMP).unwrap();
    let data = vec![[0.0f32; 4]; 128];
    let items = [data.len() as u32, 1, 1];
    let buffers = ["a", "b", "c"].map(|name| Buffer::upload(gpu, name, &data).unwrap());
    let group = |terms: usize, sums: usize| {
        let binds = [("Terms", Bind::Buffer(&buffers[terms])), ("Sums", Bind::Buffer(&buffers[sums]))];
        BindGroup::new(pipeline.layout(), &binds).unwrap()
    };
    let (first, second) = (group(0, 1), group(1, 2));
    let push = AddPush { added: 1.0 };
    let before = gpu.validation_messages();
    let mut recorder = gpu.record().unwrap();
    recorder.dispatch(&pipeline, &first, &push, items);
    if barrier {
        recorder.barrier(Access::COMPUTE_WRITE, Access::COMPUTE_READ);
    }
    recorder.dispatch(&pipeline, &second, &push, items);
    let ticket = recorder.submit().unwrap();
    gpu.wait(ticket).unwrap();
    gpu.validation_messages() - before
}

/// lavapipe does all in order, so that a missing barrier shows nowhere but in the layer's messages: this is how we know
/// that there would be some.
#[test]
fn the_layers_report_a_missing_barrier() {
    let gpu = open(Needs::Server);
    if !gpu.checks_synchronisation() {
        eprintln!("SKIPPED: the installed validation layer cannot be asked to look for missing barriers");
        return;
    }
    assert_eq!(messages_of_two_dispatches(&gpu, true), 0, "{:?}", gpu.validation_texts());
    assert!(messages_of_two_dispatches(&gpu, false) > 0, "the layer did not see a hazard");
    assert!(gpu.validation_texts()[0].contains("HAZARD"), "{:?}", gpu.validation_texts());
}

#[test]
fn compiled_pipelines_are_kept_for_the_next_start() {
    let around = tempfile::tempdir().unwrap();
    let folder = around.path().join("made/when/needed");
    for _ in 0..2 {
        let gpu = open(Needs::Client);
        gpu.load_pipelines(&folder, "test");
        let _pipeline = ComputePipeline::new(&gpu, &ADD_COMP).unwrap();
        gpu.keep_pipelines();
        let files: Vec<_> = std::fs::read_dir(&folder).unwrap().map(|entry| entry.unwrap()).collect();
        assert_eq!(files.len(), 1, "{files:?}");
        assert!(files[0].metadata().unwrap().len() >= 40, "a header and a checksum");
        assert_eq!(gpu.validation_messages(), 0, "{:?}", gpu.validation_texts());
    }
}

#[test]
fn any_number_of_scopes_may_follow_a_pass_of_two_views() {
    let gpu = open(Needs::Server);
    let format = vk::Format::R32_UINT;
    let usage = vk::ImageUsageFlags::COLOR_ATTACHMENT;
    let desc = ImageDesc { layers: 2, ..ImageDesc::new("eyes", [4, 4], format, usage) };
    let image = Image::new(&gpu, desc).unwrap();
    let color = Attachment {
        format,
        load: vk::AttachmentLoadOp::CLEAR,
        store: vk::AttachmentStoreOp::STORE,
        before: vk::ImageLayout::UNDEFINED,
        after: vk::ImageLayout::COLOR_ATTACHMENT_OPTIMAL,
    };
    let pass = RenderPassDesc { view_mask: 0b11, ..RenderPassDesc::new(vec![color]) };
    let pass = RenderPass::new(&gpu, &pass).unwrap();
    let target = Framebuffer::new(&gpu, &pass, [4, 4], &[image.view()]).unwrap();
    let mut recorder = gpu.record().unwrap();
    recorder.begin_pass(&pass, &target, &[vk::ClearValue::default()]);
    recorder.end_pass();
    (0..100).for_each(|_| recorder.scope("nothing", |_| {}));
    let timings = gpu.wait_timed(recorder.submit().unwrap()).unwrap();
    assert_eq!(timings.iter().count(), 64, "the first scopes are timed");
    assert_eq!(gpu.validation_messages(), 0, "{:?}", gpu.validation_texts());
}
