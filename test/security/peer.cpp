// Publishes or hears numbers on one topic, with or without the keys of an enclave, as rmw_fastrtps would use them.
// Built and run by test_stranger.py. Nothing leaves this machine.
#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/Topic.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>

#include <chrono>
#include <cstring>
#include <iostream>
#include <string>
#include <thread>

using namespace eprosima::fastdds::dds;
using Payload = eprosima::fastrtps::rtps::SerializedPayload_t;

// Eight bytes: an encapsulation header and a number.
struct NumberType : TopicDataType
{
    NumberType() { setName("csas::Number"); m_typeSize = 8; m_isGetKeyDefined = false; }
    bool serialize(void* data, Payload* payload) override
    {
        std::memset(payload->data, 0, 4);
        payload->data[1] = 1;
        std::memcpy(payload->data + 4, data, 4);
        payload->length = 8;
        return true;
    }
    bool deserialize(Payload* payload, void* data) override
    {
        std::memcpy(data, payload->data + 4, 4);
        return true;
    }
    std::function<uint32_t()> getSerializedSizeProvider(void*) override { return [] { return 8u; }; }
    void* createData() override { return new int32_t; }
    void deleteData(void* data) override { delete static_cast<int32_t*>(data); }
    bool getKey(void*, eprosima::fastrtps::rtps::InstanceHandle_t*, bool) override { return false; }
};

int main(int count, char** words)
{
    if (count != 6)
    {
        std::cerr << "usage: peer DOMAIN publish|hear TOPIC SECONDS ENCLAVE|-" << std::endl;
        return 64;
    }
    const int domain = std::stoi(words[1]);
    const bool publish = std::string(words[2]) == "publish";
    const double seconds = std::stod(words[4]);
    const std::string enclave = words[5];

    DomainParticipantQos qos;
    auto udp = std::make_shared<eprosima::fastdds::rtps::UDPv4TransportDescriptor>();
    udp->interfaceWhiteList.push_back("127.0.0.1");
    qos.transport().use_builtin_transports = false;
    qos.transport().user_transports.push_back(udp);
    if (enclave != "-")
    {
        // As rmw_fastrtps names them.
        auto& properties = qos.properties().properties();
        const std::string at = "file://" + enclave + "/";
        properties.emplace_back("dds.sec.auth.plugin", "builtin.PKI-DH");
        properties.emplace_back("dds.sec.auth.builtin.PKI-DH.identity_ca", at + "identity_ca.cert.pem");
        properties.emplace_back("dds.sec.auth.builtin.PKI-DH.identity_certificate", at + "cert.pem");
        properties.emplace_back("dds.sec.auth.builtin.PKI-DH.private_key", at + "key.pem");
        properties.emplace_back("dds.sec.crypto.plugin", "builtin.AES-GCM-GMAC");
        properties.emplace_back("dds.sec.access.plugin", "builtin.Access-Permissions");
        const std::string access = "dds.sec.access.builtin.Access-Permissions.";
        properties.emplace_back(access + "permissions_ca", at + "permissions_ca.cert.pem");
        properties.emplace_back(access + "governance", at + "governance.p7s");
        properties.emplace_back(access + "permissions", at + "permissions.p7s");
    }
    auto* factory = DomainParticipantFactory::get_instance();
    auto* participant = factory->create_participant(domain, qos);
    if (participant == nullptr)
    {
        std::cout << "refused: participant" << std::endl;
        return 3;
    }
    TypeSupport type(new NumberType);
    type.register_type(participant);
    auto* topic = participant->create_topic(words[3], type.get_type_name(), TOPIC_QOS_DEFAULT);
    DataWriter* writer = nullptr;
    DataReader* reader = nullptr;
    if (publish)
    {
        DataWriterQos reliable;
        reliable.reliability().kind = RELIABLE_RELIABILITY_QOS;
        writer = participant->create_publisher(PUBLISHER_QOS_DEFAULT)->create_datawriter(topic, reliable);
    }
    else
    {
        DataReaderQos reliable;
        reliable.reliability().kind = RELIABLE_RELIABILITY_QOS;
        reader = participant->create_subscriber(SUBSCRIBER_QOS_DEFAULT)->create_datareader(topic, reliable);
    }
    if (writer == nullptr && reader == nullptr)
    {
        std::cout << "refused: endpoint" << std::endl;
        return 4;
    }
    int heard = 0;
    const auto end = std::chrono::steady_clock::now() + std::chrono::duration<double>(seconds);
    for (int32_t number = 1; std::chrono::steady_clock::now() < end; ++number)
    {
        if (writer != nullptr)
        {
            writer->write(&number);
        }
        int32_t value;
        SampleInfo info;
        while (reader != nullptr && reader->take_next_sample(&value, &info) == ReturnCode_t::RETCODE_OK)
        {
            heard += info.valid_data ? 1 : 0;
        }
        std::this_thread::sleep_for(std::chrono::milliseconds(50));
    }
    std::cout << (publish ? "published" : "heard ") << (publish ? "" : std::to_string(heard)) << std::endl;
    participant->delete_contained_entities();
    factory->delete_participant(participant);
    return 0;
}
